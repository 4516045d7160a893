"""What is wrong with an input, said so that its sender can put it right."""

from __future__ import annotations


class BadInput(ValueError):
    """Input that its sender can put right. The command line prints it as one line and exits 2.

    The message says where, what came, what is allowed and what to do.
    """
