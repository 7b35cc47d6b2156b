"""Export formats, one file each: every module here registers its writer with `register_exporter`."""
