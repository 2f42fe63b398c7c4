"""Options of the test run: the device, and the tests that are left out unless -m says otherwise."""

import signal

import pytest
import warp as wp

from warpcloth.base.quiet import prepare_warp


def pytest_configure():
    """Kernels of tests are compiled as those of runs, by the headers that are parsed for these.

    A shell ignores Ctrl-C in what it runs in the background, and what the tests start would inherit that.
    """
    prepare_warp()
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="Warp device of the tests that run on one: cpu (default) or cuda:0")


@pytest.fixture(scope="session")
def device(request):
    """Name of the Warp device to test on."""
    return request.config.getoption("--device")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Arrays for which a test names no device are on the tested one, or on the CPU if the test takes no `device`."""
    wp.set_device(item.config.getoption("--device") if "device" in item.fixturenames else "cpu")


def pytest_collection_modifyitems(config, items):
    """Skips slow tests, and on a device other than the CPU also tests that do not run there or take long there."""
    if config.option.markexpr:
        return
    elsewhere = config.getoption("--device") != "cpu"
    left_out = ("slow", "host") if elsewhere else ("slow",)

    def kept(item):
        return not any(map(item.get_closest_marker, left_out)) and ("device" in item.fixturenames or not elsewhere)

    config.hook.pytest_deselected(items=[item for item in items if not kept(item)])
    items[:] = filter(kept, items)
