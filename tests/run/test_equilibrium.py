"""Rest shapes against closed forms: the heavy elastica, a hanging chain, the elastic catenary."""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import scipy.sparse

import warpcloth as wc
from support.rows import slow_but
from support.scenes import scene
from warpcloth.core.status import digits
from warpcloth.lab.elastica import aspect
from warpcloth.numerics.linear import lowest_eigenvalue
from warpcloth.run.equilibrium import SETTLED
from warpcloth.run.softened import softening

# H/W of the tip for Γ, to 8 digits.
ASPECT = {
    0.1: 0.012499554,
    0.5: 0.062444457,
    1.0: 0.12456177,
    2.0: 0.24667321,
    5.0: 0.58572118,
    10.0: 1.0668023,
    20.0: 1.8639301,
    50.0: 3.705561,
    100.0: 5.8881046,
}
# Both energies of bending are one at small angles, and differ where a hinge is bent by much.
BENT = {0.1: ("quadratic",), 1.0: ("dihedral",), 5.0: ("quadratic",), 10.0: ("quadratic", "dihedral"), 20.0: ("dihedral",)}
BENT |= {50.0: ("quadratic", "dihedral")}


def tip_aspect(scene, points):
    """H/W between the middle of the pinned vertices and the mean of the ends of the rows."""
    rest = scene.mesh.points[:, 0]
    spacing = np.unique(rest.round(9))[1]  # of vertices along the strip: half an edge, or a row
    tip = points[rest > rest.max() - 1.5 * spacing].mean(axis=0)
    clamp = 0.5 * rest[scene.pins.vertices].max()
    return -tip[1] / (tip[0] - clamp)


@pytest.mark.parametrize("gamma", ASPECT)
def test_table_of_the_elastica(gamma):
    assert aspect(gamma) == pytest.approx(ASPECT[gamma], rel=1e-7)


@pytest.mark.host
@pytest.mark.parametrize(
    ("gamma", "bending"),
    slow_but([(10.0, "quadratic")], [(gamma, bending) for gamma in BENT for bending in BENT[gamma]]),
)
def test_a_narrow_strip_is_the_elastica(gamma, bending, device):
    """One row of triangles bends with 8/9 of D: H/W at 9Γ/8 to 0.2 %, at second order in the mesh size."""
    errors = []
    for elements in (20, 40, 80):
        strip = scene("cantilever", gamma=gamma, elements=elements, bending=bending, stretching=1e6)
        rest = wc.equilibrium(strip, device=device)
        assert rest.status.result in SETTLED, rest.status
        errors.append(abs(tip_aspect(strip, rest.points) / aspect(9 * gamma / 8) - 1.0))
    assert errors[2] < 0.002
    orders = np.log2(errors[0] / errors[1]), np.log2(errors[1] / errors[2])
    print(f"{bending} Γ={gamma:g}: errors {errors}, orders {orders}")
    assert min(orders) > 1.8


@pytest.mark.slow
@pytest.mark.parametrize(("gamma", "bending"), [(0.1, "quadratic"), (1.0, "dihedral"), (5.0, "quadratic"), (50.0, "dihedral")])
def test_a_wide_sheet_is_the_elastica(gamma, bending, device):
    """As wide as long and nearly inextensible its edges stay flat: H/W at Γ to 1.5 %.

    They do where it bends by much more than its thickness, L√(12D/KL²). At Γ = 0.1 and KL²/D = 1e7 that is 11 times, and H/W
    1.9 % off however fine the mesh; there the sheet is ten times stiffer.
    """
    stretching = 1e8 if gamma == 0.1 else 1e7
    sheet = scene("cantilever", gamma=gamma, width=1.0, elements=32, bending=bending, stretching=stretching)
    rest = wc.equilibrium(sheet, device=device)
    assert rest.status.result in SETTLED, rest.status
    error = tip_aspect(sheet, rest.points) / ASPECT[gamma] - 1.0
    print(f"{bending} Γ={gamma:g}: {error:+.3%}, {rest.iterations} iterations")
    assert abs(error) < 0.015


@pytest.mark.parametrize("links", [1, 5, 20])
def test_a_hanging_chain(links, device):
    """N springs k and N masses m: the tip hangs (mg/k)·N(N+1)/2 lower."""
    k, m = 1e3, 0.01
    chain = scene("chain", links=links, mass=m, stiffness=k)
    rest = wc.equilibrium(chain, tolerance=1e-13, device=device)
    extension = -rest.points[-1, 1] - 1.0
    assert extension == pytest.approx(m * 9.81 / k * links * (links + 1) / 2, rel=1e-9)


@pytest.mark.parametrize(("stretching", "sag"), [(1e4, 0.29240076), (1e2, 0.29792987)])
def test_an_elastic_catenary(stretching, sag, device):
    """Sag of the continuous cable at second order in the number of links."""
    errors = []
    for links in (50, 100, 200):
        rest = wc.equilibrium(scene("catenary", links=links, stretching=stretching), device=device)
        assert rest.status.result in SETTLED, rest.status
        errors.append(-rest.points[:, 1].min() / sag - 1.0)
    orders = np.log2(errors[0] / errors[1]), np.log2(errors[1] / errors[2])
    assert errors[2] < 2e-5
    assert np.allclose(orders, 2.0, atol=0.05)


def test_load_steps_end_in_the_same_shape(device):
    """With one load step the strip starts from softer ones, in fewer than half of the iterations of stiff load steps."""
    strip = scene("cantilever", gamma=10.0, elements=20)
    soft, stiff = (wc.equilibrium(strip, load_steps=steps, device=device) for steps in (1, 3))
    print(f"{soft.iterations} and {stiff.iterations} iterations")
    assert np.abs(soft.points - stiff.points).max() < 1e-6
    assert soft.iterations < stiff.iterations / 2


def test_an_arch_that_is_nearly_at_rest_stands(device):
    """It would fall if it stretched more easily; 10 iterations leave a residual of 1e-8."""
    angles = np.linspace(-0.9, 0.9, 24)
    edge = np.stack([np.sin(angles), np.cos(angles), np.zeros(24)], axis=1)
    triangles = [each for i in range(23) for each in ((i, i + 1, 24 + i), (i + 1, 25 + i, 24 + i))]
    mesh = wc.Mesh(np.concatenate([edge, edge + np.array([0.0, 0.0, 0.1])]), triangles)
    terms = [wc.Spring(stiffness=1e5), wc.DihedralBending(stiffness=0.1)]
    arch = wc.Scene(mesh, density=0.2, terms=terms, pins=[0, 1, 22, 23, 24, 25, 46, 47])
    rest, as_it_is = wc.equilibrium(arch, device=device), wc.equilibrium(arch, device=device, start=arch.positions)
    assert rest.stable and rest.points[12, 1] > 0.98 and np.abs(rest.points - as_it_is.points).max() < 1e-9


def test_tense_cloth_is_not_taken_for_stiffer_cloth(device):
    """Springs with 0.8 of the length of their edges: ∂²U/∂ε² is that of springs without tension, for equal k A."""
    mesh, found = wc.Mesh.grid(6, 6), {}
    for stiffness in (1e3, 1e7):
        for part in (1.0, 0.8):
            spring = wc.Spring(stiffness=stiffness, rest_lengths=part * mesh.edge_lengths)
            tense = wc.Scene(mesh, density=0.2, terms=[spring], pins=[0, 5])
            found[stiffness, part] = softening(tense.build(device=device, dtype="float64"))
    assert found[1e3, 1.0] == found[1e3, 0.8] == [] and len(found[1e7, 1.0]) > 0
    assert 0.8 < found[1e7, 0.8][0] / found[1e7, 1.0][0] < 1.25


def test_softer_cloth_leaves_iterations_for_the_cloth_itself(device):
    """A hanging chain settles in 4 iterations once its proximal steps begin; of 12, half are for softer chains."""
    chain = wc.Scene(wc.Mesh.chain(8), masses=[1] * 8, terms=[wc.Spring(stiffness=1e9)], pins=[0])
    assert wc.equilibrium(chain, iterations=12, device=device).status.result in SETTLED


def test_without_anything_that_holds_it_is_not_converged(device):
    """A free cloth under gravity has no rest shape, and that is said."""
    free = wc.Scene(wc.Mesh.grid(3, 3), density=0.1, terms=[wc.Spring(stiffness=10.0)])
    rest = wc.equilibrium(free, iterations=50, device=device)
    assert rest.status.result not in SETTLED


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"tolerance": 0.0}, "tolerance is 0.0"),
        ({"load_steps": 0}, "load_steps is 0"),
        ({"iterations": 2.5}, "iterations is 2.5"),
        ({"linear": "lu"}, "linear is 'lu'"),
    ],
)
def test_options_are_checked(option, message):
    with pytest.raises(ValueError, match=message):
        wc.equilibrium(scene("chain"), **option)


UNSTABLE = {
    "a chain that stands on its pin": wc.Scene(
        wc.Mesh.chain(6, direction=(0, 1, 0)), masses=np.full(6, 0.01), terms=[wc.Spring(stiffness=1e3)], pins=[0]
    ),
    "a sheet upright on two corners": wc.Scene(
        wc.Mesh(wc.Mesh.grid(9, 9).points[:, [0, 2, 1]], wc.Mesh.grid(9, 9).triangles),
        density=0.1,
        terms=[wc.Spring(stiffness=1e3), wc.QuadraticBending(stiffness=1e-3)],
        pins=[0, 8],
    ),
}


@pytest.mark.parametrize("name", UNSTABLE)
def test_balance_that_is_no_minimum_is_left(name, device):
    """In exact symmetry no force says so, but the Hessian does: nudged, they fall and hang."""
    rest = wc.equilibrium(UNSTABLE[name], device=device)
    assert rest.status.result in SETTLED, rest.status
    assert rest.points[:, 1].mean() < -0.4 and rest.stable


@pytest.mark.parametrize("stretching", [1e4, 1e8])
def test_float32_comes_near_float64(stretching, device):
    """The noise of stiff springs in the residual must not end the descent while the strip still sinks.

    It is kε‖d‖, not kε of a length, so that it loses to bending only beyond kL²/D = 1e10.
    """
    strip = scene("cantilever", stretching=stretching)
    single, double = (wc.equilibrium(strip, dtype=dtype, device=device) for dtype in ("float32", "float64"))
    assert ", converged as far as rounding allows: " in single.status.message and 0.0 < single.status.distance < 1e-3
    assert np.abs(single.points - double.points).max() < 1e-4


def test_what_rounding_hides_is_no_rest_shape(device):
    """With kL²/D = 1e12 float32 leaves forces of 2 to 1e7 times the weight, and the strip 0.7 m away.

    Rounding decides too whether the descent ends there or uses up its iterations.
    """
    status = wc.equilibrium(scene("cantilever", stretching=1e12), dtype="float32", device=device).status
    assert status.result not in SETTLED and not status and status.residual > 0.5


def test_a_sheet_too_stiff_to_move_is_no_rest_shape(device):
    """Its whole weight is left unbalanced, 1 in the residual but for an ulp to either side, which decides nothing."""
    mesh = wc.Mesh.grid(5, 5)
    for density in (0.1, 0.3, 0.7, 1e-3):
        sheet = wc.Scene(mesh, density=density, terms=[wc.Spring(stiffness=1e18)], pins=[0, 4])
        rest = wc.equilibrium(sheet, device=device)
        assert rest.status.result not in SETTLED and not rest.stable, rest.status
        assert "; rounding hides the equilibrium in float64" in rest.status.message
        assert rest.status.residual > 1.0 - 1e-6  # and what lengths are rounded by times the stiffness, which is 0 on the CPU


@pytest.mark.parametrize("dtype", slow_but(["float64"], ["float32", "float64"]))
def test_what_is_at_rest_without_weight_is_settled(dtype, device):
    """The forces at the start are rounding, and those that are left are as large: nothing that a rest shape could hide."""
    for seed in range(4):
        mesh = wc.Mesh.grid(5, 5)
        mesh = wc.Mesh(mesh.points + 0.05 * np.random.default_rng(seed).normal(size=mesh.points.shape), mesh.triangles)
        for terms in ([wc.Spring(stiffness=1e3), wc.DihedralBending(stiffness=1e-3)], [wc.NeoHookeanMembrane(stiffness=1e3)]):
            rest = wc.equilibrium(wc.Scene(mesh, density=0.1, terms=terms, gravity=(0, 0, 0)), dtype=dtype, device=device)
            assert rest.status.result in SETTLED and rest.stable, rest.status
            assert np.abs(rest.points - mesh.points).max() < (1e-2 if dtype == "float32" else 1e-6)


def test_a_saddle_that_is_not_left_is_reported(device, monkeypatch):
    """What no nudge moves away from is in balance, and said to be no more."""
    monkeypatch.setattr("warpcloth.numerics.minimise.Minimiser.curves_down", lambda self, tolerance: True)
    rest = wc.equilibrium(scene("chain", links=3), device=device)
    assert rest.status.result.name == "SADDLE"


@pytest.mark.parametrize("stretch", slow_but([1.01, 1.2], [1.01, 1.02, 1.05, 1.1, 1.2, 1.3]))
def test_a_circle_of_minima_is_no_saddle(stretch, device):
    """A chain of two links too long for its span may buckle any way round: a zero eigenvalue is not a negative one."""
    mesh = wc.Mesh([[0, 0, 0], [1, 1, 0], [2, 2, 0]], edges=[[0, 1], [1, 2]])
    spring = wc.Spring(stiffness=10.0, rest_lengths=stretch * np.sqrt(2.0))
    rest = wc.equilibrium(wc.Scene(mesh, masses=np.ones(3), terms=[spring], pins=[0, 2], gravity=(0, 0, 0)), device=device)
    assert rest.status.result in SETTLED
    lengths = np.linalg.norm(np.diff(rest.points, axis=0), axis=1)
    assert lengths == pytest.approx(stretch * np.sqrt(2.0), rel=1e-6)


def test_a_slack_part_does_not_hide_a_saddle(device):
    """A link that lies slack makes the Hessian singular; the chain under pressure beside it still buckles."""
    mesh = wc.Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 0, 0], [6, 0, 0]], edges=[[0, 1], [1, 2], [3, 4]])
    spring = wc.Spring(stiffness=10.0, rest_lengths=[1.5, 1.5, 1.0])
    cloth = wc.Scene(mesh, masses=np.ones(5), terms=[spring], pins=[0, 2, 3], gravity=(0, 0, 0))
    rest = wc.equilibrium(cloth, device=device)
    assert np.linalg.norm(rest.points[1] - rest.points[0]) == pytest.approx(1.5, rel=1e-6)


def test_a_light_vertex_is_in_balance_beside_a_heavy_one(device):
    """Balance is asked of every vertex: 1e6 kg elsewhere excuse nothing at 1e-3 kg."""
    mesh = wc.Mesh([[0, 0, 0], [1, 0, 0], [3, 0, 0], [4, 0, 0]], edges=[[0, 1], [2, 3]])
    spring = wc.Spring(stiffness=[10.0, 1e9])
    cloth = wc.Scene(mesh, masses=[1.0, 1e-3, 1.0, 1e6], terms=[spring], pins=[0, 2])
    rest = wc.equilibrium(cloth, device=device)
    assert rest.points[1] == pytest.approx([0.0, -1.0 - 1e-3 * 9.81 / 10.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("light", [1.0, 1e-6, 1e-12])
def test_what_weighs_nothing_hides_no_rest_shape(light, device):
    """A chain under its own weight: the forces that rounding leaves at a light mass are held against the whole load."""
    k, masses = 1e5, np.full(6, 1e-3) * [1, 1, 1, light, 1, 1]
    chain = wc.Scene(wc.Mesh.chain(6), masses=masses, terms=[wc.Spring(stiffness=k)], pins=[0])
    rest = wc.equilibrium(chain, device=device)
    assert rest.status.result.name == "CONVERGED" and rest.status.residual <= 1e-8, rest.status
    assert "times the weight (tolerance 1e-08)" in rest.status.message
    below = np.cumsum(masses[:0:-1])[::-1] * 9.81
    assert -np.diff(rest.points[:, 1]) == pytest.approx(0.2 + below / k, rel=1e-9)


STANDING = {"held": (1.5, True), "held too little": (0.5, False)}


@pytest.mark.parametrize(("share", "stable"), STANDING.values(), ids=STANDING)
def test_stability_of_a_mass_on_a_strut(share, stable, device, monkeypatch):
    """A mass on a strut of length l falls sideways with −mg/l, and an attachment k at its head holds it: k − mg/l [N/m]."""
    k, m = 1e3, 0.5
    length = 1.0 - m * 9.81 / k
    head = share * m * 9.81 / length
    strut = wc.Scene(
        wc.Mesh.chain(2, direction=(0, 1, 0)),
        masses=np.full(2, m),
        terms=[wc.Spring(stiffness=k), wc.Attachment(vertices=[1], stiffness=head, targets=[[0.0, length, 0.0]])],
        pins=[0],
    )
    monkeypatch.setattr(import_module("warpcloth.run.equilibrium"), "_nudge", lambda model: 0.0)
    rest = wc.equilibrium(strut, device=device)
    assert rest.points[1] == pytest.approx([0.0, length, 0.0], abs=1e-9)
    assert rest.lowest_eigenvalue == pytest.approx(head - m * 9.81 / length, rel=1e-6)
    assert rest.stable is stable and (rest.status.result in SETTLED) is stable
    said = (
        f"not usable: it is not stable, because the lowest eigenvalue of the Hessian is {digits(rest.lowest_eigenvalue)} N/m; "
    )
    assert (said in rest.status.message) is not stable
    monkeypatch.undo()
    assert wc.equilibrium(strut, device=device).stable


def test_rigid_motions_are_no_instability(device):
    """A sheet that nothing holds has six eigenvalues of 0, here stirred by its rounding; a hanging one has none."""
    mesh = wc.Mesh.grid(9, 9)
    turned = mesh.points @ wc.polar(np.random.default_rng(0).normal(size=(3, 3)))[0]
    terms = [wc.Spring(stiffness=1e3), wc.DihedralBending(stiffness=1e-3)]
    free = wc.equilibrium(wc.Scene(mesh, density=0.1, terms=terms, positions=turned, gravity=(0, 0, 0)), device=device)
    assert free.stable and abs(free.lowest_eigenvalue) < 1e-9
    held = wc.equilibrium(wc.Scene(mesh, density=0.1, terms=terms, pins="corners"), device=device)
    assert held.stable and held.lowest_eigenvalue > 1e-3
    pinned = wc.equilibrium(wc.Scene(mesh, density=0.1, terms=terms, pins="all"), device=device)
    assert pinned.stable and pinned.lowest_eigenvalue == np.inf
    unfinished = wc.equilibrium(wc.Scene(mesh, density=0.1, terms=terms), iterations=20, device=device)
    assert not unfinished.stable and np.isnan(unfinished.lowest_eigenvalue)
    assert "not usable: it is not an equilibrium; " in unfinished.status.message


@pytest.mark.parametrize("lowest", [-3e4, -1e-3, 0.0, 1e-3, 10.0])
@pytest.mark.parametrize("n", [30, 600])
def test_the_lowest_eigenvalue(n, lowest):
    """Of the Laplacian of a path, 2 − 2 cos(πj/(n+1)), where all are moved and one is put far below."""
    matrix = 1e5 * scipy.sparse.diags([-1.0, 2.0, -1.0], [-1, 0, 1], (n, n))
    smallest = 1e5 * (2.0 - 2.0 * np.cos(np.pi / (n + 1)))
    moved = matrix + (lowest - smallest) * scipy.sparse.identity(n)
    assert lowest_eigenvalue(moved) == pytest.approx(lowest, rel=1e-6, abs=1e-7)
    assert lowest_eigenvalue(scipy.sparse.block_diag([moved, [[-1e3]]])) == pytest.approx(min(lowest, -1e3), rel=1e-6)
    assert np.isnan(lowest_eigenvalue(moved * np.nan)) and lowest_eigenvalue(scipy.sparse.csc_array((0, 0))) == np.inf


@pytest.mark.parametrize("load_steps", [1, 4])
def test_pins_end_at_their_last_keyframe(load_steps, device):
    """A cable whose end is carried to where another starts hangs as that one does."""
    started = scene("catenary", links=20)
    ends = started.positions[started.pins.vertices]
    away = ends + np.linspace(0.0, 1.0, 5)[:, None, None] * [[[0.0, 0.0, 0.0], [0.0, -0.3, 0.2]]]
    moved = replace(started, pins=wc.Pins(started.pins.vertices, away))
    fixed = replace(started, pins=started.pins.vertices)
    positions = started.positions.copy()
    positions[started.pins.vertices] = away[-1]
    one = wc.equilibrium(moved, load_steps=load_steps, device=device)
    other = wc.equilibrium(replace(fixed, positions=positions), device=device)
    assert one.status.result in SETTLED and other.status.result in SETTLED
    assert np.array_equal(one.points[started.pins.vertices], away[-1])
    assert np.abs(one.points - other.points).max() < 1e-6


def over(**fields):
    """A sheet that hangs by an edge, with a copy of it 0.1 m higher."""
    grid = wc.Mesh.grid(4, 4, size=0.3)
    points = np.concatenate([grid.points, grid.points + np.array([0.0, 0.1, 0.0])])
    mesh = wc.Mesh(points, np.concatenate([grid.triangles, grid.triangles + 16]))
    terms = [wc.Spring(stiffness=100.0), wc.QuadraticBending(stiffness=1e-3)]
    return wc.Scene(mesh, density=0.1, terms=terms, pins=[0, 1, 2, 3, 16, 17, 18, 19], **fields)


BALL = wc.Sphere(position=(0.15, -0.4, 0.15), radius=0.1)
BAD_STARTS = {
    "crosses itself": ({"self_contact": wc.SelfContact(distance=5e-3)}, slice(20, None), [0.02, -0.15, 0.01], " cross at the "),
    "inside": ({"colliders": [BALL]}, [5], [0.05, -0.4, 0.05], r"vertex 5 starts .* the collider .* in start"),
}


@pytest.mark.parametrize(("fields", "vertices", "move", "message"), BAD_STARTS.values(), ids=BAD_STARTS)
def test_a_start_is_checked_as_that_of_a_scene(fields, vertices, move, message):
    """As Scene.positions are, and at the same shape."""
    cloth = over(**fields)
    start = cloth.positions.copy()
    start[vertices] += move
    with pytest.raises(ValueError, match=message):
        wc.equilibrium(cloth, start=start)
    with pytest.raises(ValueError, match=message.removesuffix(" in start")):
        wc.equilibrium(replace(cloth, positions=start))


def test_a_start_moves_no_pins_and_no_locked_axes(device):
    """From a start 0.3 m away: pins and the locked z stay, those with keyframes end at the last; the rest shape is the same."""
    axes = np.ones((32, 3), dtype=bool)
    axes[8:16, 2] = False
    cloth = over(free_axes=axes)
    last, away = cloth.positions[cloth.pins.vertices] + [0.0, 0.02, 0.0], np.array([0.3, 0.0, 0.1])
    for pins in (cloth.pins, wc.Pins(cloth.pins.vertices, [last - [0.0, 0.02, 0.0], last])):
        scene = replace(cloth, pins=pins)
        rest = wc.equilibrium(scene, device=device)
        moved = wc.equilibrium(scene, device=device, start=rest.points + away)
        assert moved.status.ok
        held = cloth.positions[cloth.pins.vertices] if pins.keyframes is None else last
        assert np.array_equal(moved.points[cloth.pins.vertices], held)
        assert np.array_equal(moved.points[8:16, 2], cloth.positions[8:16, 2])
        assert np.abs(moved.points - rest.points).max() < 1e-6
