"""Cameras, photographs and what belongs to them, in memory."""
