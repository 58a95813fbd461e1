"""Materials as a user would write them, outside the package, one file each."""
