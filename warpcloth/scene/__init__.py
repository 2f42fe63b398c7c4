"""Scenes, colliders and contact: the records that a user declares."""
