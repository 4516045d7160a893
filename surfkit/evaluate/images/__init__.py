"""Renders against held-out photographs."""
