"""Tools of the fault tests: processes that die at a chosen file operation, damage, hostile files, a bad network."""
