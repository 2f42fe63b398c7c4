"""Runs in the kernel before the cells of a page, so that a shell command that fails ends the build.

A command that is expected to fail has the code in a comment at its end, as `!warpcloth check cloth.usdc  # exit code 1`.
"""


def _checked(run):
    import re

    def system(command):
        run(command)
        code = get_ipython().user_ns["_exit_code"]  # noqa: F821, a name of the kernel
        said = re.search(r"# exit code (\d+)$", command)
        if code != (int(said[1]) if said else 0):
            raise RuntimeError(f"{command} ended with exit code {code}")

    return system


get_ipython().system = _checked(get_ipython().system)  # noqa: F821
del _checked
