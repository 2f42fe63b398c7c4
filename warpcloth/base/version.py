"""The version of this package."""


def installed_version():
    """Returns the installed version, or None if the package is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("warpcloth")
    except PackageNotFoundError:
        return None
