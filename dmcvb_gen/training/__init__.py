"""Learners of behaviour policies: tasks and settings in, run folders of checkpoints and picked policy files out."""
