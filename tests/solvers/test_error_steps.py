"""Steps by error: the estimate and the order against closed forms, the bits of steps, and the work that they save."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from support.scenes import scene as named
from support.steps import after_frames, hanging_mass
from warpcloth.core.status import Result
from warpcloth.solvers.error_steps import KEPT, LONGEST, SHORTEST

MASS, STIFFNESS, GRAVITY = 1.0, 40.0, 9.81
OMEGA = np.sqrt(STIFFNESS / MASS)


def oscillator(damping=None, fps=4.0):
    """A mass on a spring along gravity, which starts at rest at the rest length."""
    terms = [wc.Spring(stiffness=STIFFNESS, damping=damping)]
    return replace(hanging_mass(STIFFNESS, MASS, 0.0), terms=terms, fps=fps)


def fall(t, damping=0.0):
    """The distance by which the mass has moved down after a time t [s]."""
    decay = 0.5 * damping / MASS
    omega = np.sqrt(OMEGA**2 - decay**2)
    return GRAVITY / OMEGA**2 * (1.0 - np.exp(-decay * t) * (np.cos(omega * t) + decay / omega * np.sin(omega * t)))


def moved(stepper):
    x = stepper.state.x.numpy()
    return np.linalg.norm(x[1] - x[0]) - 1.0


def errors(stepper, frames, damping=0.0):
    """Returns the error of the mass after each frame [m]."""
    found = []
    for frame in range(1, frames + 1):
        stepper.frame()
        found.append(moved(stepper) - fall(frame / stepper.model.scene.fps, damping))
    return np.abs(found)


def bound(scene, record, **build):
    return record.bind(scene.build(dtype="float64", **build))


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("midpoint", 2)])
def test_estimates_and_orders_are_those_of_closed_forms(integrator, order):
    """h is proportional to error^(1/(p+1)), so that a tolerance of 1/4^(p+1) quarters h and divides the error by 4^p."""
    record = wc.Newton(error=1e-4, integrator=integrator, tolerance=1e-10)
    estimating = bound(oscillator(), record)
    estimating.step()
    estimating.step()
    h = 0.25 / 2**estimating._k
    # The third and higher derivatives, of a relative size of ωh, are not in the estimate.
    assert estimating._error[0] * 1e-4 == pytest.approx(abs(moved(estimating) - fall(2.0 * h)), rel=2.0 * OMEGA * h)
    coarse, fine = (bound(oscillator(), replace(record, error=1e-4 / part)) for part in (1.0, 4.0 ** (order + 1)))
    ratio = errors(coarse, 8).max() / errors(fine, 8).max()
    assert ratio == pytest.approx(4.0**order, rel=0.35)
    assert fine.length.taken == pytest.approx(4 * coarse.length.taken, rel=0.35)


def test_a_motion_that_ends_takes_a_fraction_of_the_steps():
    damping, frames = 8.0, 80  # the motion falls to 1e-7 in 4 s of 20
    by_error = bound(oscillator(damping), wc.Newton(error=1e-6, tolerance=1e-10))
    fixed = bound(oscillator(damping), wc.Newton(substeps=256, tolerance=1e-10))
    assert errors(by_error, frames, damping).max() < errors(fixed, frames, damping).max()
    assert by_error.length.tried < 256 * frames / 6
    assert by_error.steps_per_frame == 2**LONGEST and by_error.kept == KEPT


ALIKE = {
    "newton": ("hanging", {"n": 6, "stiffness": 100.0}, wc.Newton(error=1e-6), {}),
    "admm": ("hanging", {"n": 6, "stiffness": 100.0}, wc.ADMM(error=1e-6), {}),
    "midpoint": ("curtain", {"nx": 13, "ny": 9}, wc.Newton(error=1e-8, integrator="midpoint"), {}),
    "batch": ("hanging", {"n": 6}, wc.ProjectiveDynamics(error=1e-6), {"copies": 2, "vary": {"Spring.stiffness": [50.0, 1e3]}}),
    "threads": ("hanging", {"n": 6}, wc.XPBD(error=1e-6), {"copies": 2, "threads": 2}),
    "pins": ("curtain", {"nx": 13, "ny": 9}, wc.ConstrainedDynamics(error=1e-5), {}),
    "contact": ("drape", {"n": 8}, wc.Newton(error=1e-6), {}),
    "self-contact": ("fold", {"nx": 6, "ny": 15}, wc.Newton(error=1e-6), {}),
}


@pytest.mark.parametrize("scene, values, record, build", ALIKE.values(), ids=ALIKE)
def test_steps_have_the_bits_of_fixed_ones_after_rejections(scene, values, record, build):
    """A frame whose first pairs were rejected, and whose steps are all of one length, is a frame of that length."""
    scene = named(scene, **values)
    by_error = bound(scene, record, **build)
    by_error.frame()
    substeps = by_error.steps_per_frame
    assert by_error.length.rejected and substeps == 2**by_error.length.shortest
    fixed = bound(scene, replace(record, error=None, substeps=substeps), **build)
    fixed.frame()
    found, wanted = by_error.state.to_host(), fixed.state.to_host()
    for name, values in wanted.items():
        if name.split("share 0 ")[-1].split("share 1 ")[-1].startswith("steps of"):
            values = values * (2**SHORTEST // substeps)
        np.testing.assert_array_equal(found[name], values, name)


def test_frames_steps_resets_and_states_give_the_same_bits():
    scene = named("drape", n=8)
    frames, steps, again = (bound(scene, wc.Newton(error=1e-3)) for _ in range(3))
    lengths = []
    for frame in range(14):
        frames.frame()
        lengths.append(frames.steps_per_frame)
        assert sum(1 for _ in steps.steps_of_frame()) == lengths[-1] and frames.state == steps.state
        if frame == 6:
            again.state.from_host(frames.state.to_host())
        elif frame > 6:
            again.frame()
    assert again.state == frames.state and len(set(lengths)) > 2 and frames.kept <= KEPT
    steps.step()
    with pytest.raises(ValueError, match="reset is within a frame; with error it must come at the end of one"):
        steps.reset()
    frames.reset()
    frames.frame()
    assert frames.state == after_frames(scene, wc.Newton(error=1e-3), 1, dtype="float64").state


def test_copies_of_threads_are_reset_as_those_of_one():
    scene, found = named("hanging", n=6), []
    for threads in (1, 2):
        stepper = bound(scene, wc.XPBD(error=1e-3), copies=2, threads=threads)
        start = stepper.state.x.numpy()[: stepper.model.per_copy].copy()
        stepper.frame()
        stepper.reset(np.array([True, False]))
        assert (stepper.state.x.numpy()[: len(start)] == start).all()
        stepper.frame()
        found.append(stepper.state.x.numpy())
    np.testing.assert_array_equal(*found)


def test_all_copies_take_the_steps_of_the_one_that_needs_them():
    scene, record, stiffness = oscillator(), wc.Newton(error=1e-4, tolerance=1e-10), [STIFFNESS, 16.0 * STIFFNESS]
    taken = []
    for values in (stiffness, stiffness[:1], stiffness[1:]):
        build = {"dtype": "float64", "copies": len(values), "vary": {"Spring.stiffness": values}}
        taken.append(after_frames(scene, record, 4, **build).length.taken)
    both, *alone = taken
    assert both >= max(alone) > 1.2 * min(alone)


def test_a_step_that_is_not_accurate_enough_is_reported():
    status = wc.simulate(oscillator(), wc.Newton(error=1e-18), frames=1, dtype="float64").status
    assert status.result is Result.INACCURATE and "error above its tolerance with the shortest step" in status.message


def test_records_of_moving_pins_do_not_change_the_motion_and_others_are_refused():
    scene, record = named("curtain", nx=13, ny=9), wc.Newton(error=1e-3)
    with pytest.raises(ValueError, match="record is 'energies' of a scene with contact or air"):
        wc.simulate(scene, record, frames=1, dtype="float64", record="energies")
    scene = replace(scene, colliders=(), contact=None)
    plain, recorded = (wc.simulate(scene, record, frames=6, dtype="float64", record=each) for each in ((), "energies"))
    np.testing.assert_array_equal(plain.points, recorded.points)
    found = recorded.energies
    gained = sum(found[name] for name in found if not name.startswith("work")) - found["work of pins"]
    assert (np.diff(gained) < 1e-3 * np.abs(found["work of pins"]).max()).all()  # Euler and damping take energy away


@pytest.mark.parametrize("error", [1e-3, 1e-4])
def test_the_share_of_cut_moves_is_one_of_time(error):
    """Of two sheets that fall, one is stopped 1 mm below: half of the moves are cut from √(2·1 mm/g) on, up to 1/8 frame."""
    sheet = wc.Mesh.grid(3, 3, size=0.2)
    mesh = wc.Mesh.join({"stopped": sheet, "free": wc.Mesh(sheet.points + np.array([1.0, 0.0, 0.0]), sheet.triangles)})
    below = wc.Box(size=(1.0, 0.2, 1.0), position=(0.0, -0.101, 0.0))
    fields = {"colliders": [below], "contact": wc.Contact(stiffness=1e-3, distance=1e-4)}  # too soft to bear the sheet
    scene = wc.Scene(mesh, density=0.15, terms=[wc.Spring(stiffness=100.0)], duration=8 / 60, **fields)
    stepper = bound(scene, wc.Newton(error=error))
    steps = [stepper.frame() or stepper.steps_per_frame for _ in range(8)]
    assert steps[0] > steps[1] and steps[0] >= 8
    assert stepper.cut[0] == pytest.approx(0.5 * (1.0 - np.sqrt(2e-3 / GRAVITY) / scene.duration), abs=0.5 / 8 / 8)
