"""One file per benchmark; each registers itself, as docs/extending.md shows."""
