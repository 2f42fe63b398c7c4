"""Versions of packages."""


def installed_version(package="warpcloth"):
    """Returns the installed version of a package, or None if it is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return None
