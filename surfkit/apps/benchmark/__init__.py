"""Locked benchmarks: `surfkit benchmark`."""
