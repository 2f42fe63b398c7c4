"""The version of this package."""


def installed_version():
    """Returns the version that is installed; None in a checkout that is not."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("warpcloth")
    except PackageNotFoundError:
        return None
