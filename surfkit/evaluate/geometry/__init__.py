"""Surfaces against true geometry."""
