"""Animations in notebooks. They are shown by a package above those that define them, which is loaded when one is shown."""

_show = None


def show_by(function):
    """Sets the function that returns the HTML of an animation, or None if it cannot be drawn."""
    global _show
    _show = function
    return function


class ShownInNotebooks:
    """An animation that a notebook shows as a page, see :func:`warpcloth.view`; one of more than 5 MB as a line of text."""

    def _repr_html_(self) -> str | None:
        return None if _show is None else _show(self)
