"""The command line, called in this process."""

from warpcloth.cli import main


def run(capfd, *argv):
    """(exit code, stdout, stderr) of a command in this process."""
    capfd.readouterr()
    code = main([str(argument) for argument in argv])
    return code, *capfd.readouterr()


def refused(capfd, argv, fragment):
    code, out, err = run(capfd, *argv)
    assert (code, out) == (2, "")
    assert err.startswith("warpcloth: ") and err.endswith("\n") and err.count("\n") == 1
    assert fragment in err
    assert "Traceback" not in err
