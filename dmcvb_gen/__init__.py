"""dmcvb-gen: the open generator behind a DMC-VB style benchmark."""

__version__ = "0.1.0"
