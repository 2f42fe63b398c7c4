"""Instances of Warp structs."""


def filled(struct, **values):
    """An instance of a struct with values by name. It keeps its arrays alive."""
    made = struct()
    for name, value in values.items():
        setattr(made, name, value)
    return made
