"""The records that a user declares."""
