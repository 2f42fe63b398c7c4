"""The functions of each energy, one file each."""
