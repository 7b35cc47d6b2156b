"""Readers: releases for training (xarray, torch, numpy) and environments for evaluation (Gymnasium).

Nothing is imported here: `import dmcvb_gen` passes, and must stay quick.
"""
