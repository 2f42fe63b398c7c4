"""The records that a scene is made of."""
