"""Textures of a mesh from the photographs."""
