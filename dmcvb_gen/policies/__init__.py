"""Policies that act: policy files, their fixed-order actor, simulation with them, the package's own; no torch here."""
