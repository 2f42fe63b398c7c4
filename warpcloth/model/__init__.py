"""Models: scenes built on a device."""
