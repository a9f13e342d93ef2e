"""Reproducible experiments on invariant inverse reinforcement learning."""

__version__ = "0.2.0"
