"""Runs in the kernel before the cells of a page, so that a shell command that fails ends the build."""


def _checked(run):
    def system(command):
        run(command)
        code = get_ipython().user_ns["_exit_code"]  # noqa: F821, a name of the kernel
        if code > 1:  # 1 says that `warpcloth check` found something
            raise RuntimeError(f"{command} ended with {code}")

    return system


get_ipython().system = _checked(get_ipython().system)  # noqa: F821
del _checked
