"""Models: scenes on a device, with all arrays of terms, loads and colliders."""
