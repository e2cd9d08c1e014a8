"""Probabilistic programming for preference-based reinforcement learning."""
