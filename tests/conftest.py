"""Options of the test run: the device, and the slow tests, which are left out unless -m says otherwise."""

import pytest


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="Warp device of the tests that run on one: cpu (default) or cuda:0")


@pytest.fixture(scope="session")
def device(request):
    """Name of the Warp device to test on."""
    return request.config.getoption("--device")


def pytest_collection_modifyitems(config, items):
    if config.option.markexpr:
        return
    slow = [item for item in items if item.get_closest_marker("slow")]
    if slow:
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if not item.get_closest_marker("slow")]
