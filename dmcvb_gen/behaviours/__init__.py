"""Behaviour policies: those that act (policies, no torch) and how they are learned (learning)."""
