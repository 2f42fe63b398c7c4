"""Tests of the advice on what matters in a scene, where that is known beforehand."""

import json
from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.cli import main
from warpcloth.lab.advice import advise
from warpcloth.scenes import hanging, incline

NEWTON = wc.Newton(substeps=8, integrator="bdf2")


def by_name(found):
    return {trial.name: trial for trial in found.trials}


@pytest.mark.slow
def test_terms_that_do_nothing_do_not_matter_and_others_do():
    """Bending of 1e-9 N·m is next to none, an attachment to where a pin stands does nothing, springs hold the cloth."""
    scene = hanging.scene(n=6, bending=1e-9)
    scene = replace(scene, terms=[*scene.terms, wc.Attachment(vertices=[0], stiffness=10.0)])
    found = advise(scene, NEWTON, frames=10)
    trials = by_name(found)
    assert trials["without Attachment"].change == 0.0 and trials["without Attachment"].matters is False
    assert 0.0 < trials["without QuadraticBending"].change < 1e-4 and trials["without QuadraticBending"].matters is False
    assert trials["without Spring"].matters and trials["without Spring"].change > 0.01
    assert trials["float32"].matters is False and trials["substeps=16"].matters is False
    leave_out = [sentence for sentence in found.sentences if "leave it out" in sentence]
    assert len(leave_out) == 2 and not any("Spring " in sentence for sentence in leave_out)


def test_the_change_is_the_distance_of_two_runs():
    scene = hanging.scene(n=5, bending=1e-2)
    found = by_name(advise(scene, NEWTON, tolerance=1e-4, frames=6))["without QuadraticBending"]
    runs = [wc.simulate(each, NEWTON, frames=6).points for each in (scene, replace(scene, terms=scene.terms[:1]))]
    distance = np.linalg.norm(runs[1].astype(float) - runs[0], axis=2)
    assert found.change == pytest.approx(np.sqrt((distance**2).mean()), rel=1e-6) and found.matters
    assert not by_name(advise(scene, NEWTON, tolerance=1.01 * found.change, frames=6))["without QuadraticBending"].matters


def test_a_step_that_is_too_large_is_said():
    found = advise(hanging.scene(n=6), wc.Newton(substeps=1), tolerance=1e-3, frames=20)
    assert by_name(found)["substeps=2"].matters and "take a smaller one" in found.sentences[0]


def test_resolutions_are_compared_by_their_surfaces():
    """A finer sheet that moves as the coarse one does changes nothing; one in another place by how far it is."""

    def sheet(n, height):
        mesh, springs = wc.Mesh.grid(n, n), [wc.Spring(stiffness=100.0)]
        positions = mesh.points + np.array([0.0, height, 0.0])
        return wc.Scene(mesh, density=0.1, terms=springs, positions=positions, gravity=(0, 0, 0), duration=0.1)

    flat, fine, away = sheet(5, 0.0), sheet(9, 0.0), sheet(9, 0.25)
    found = by_name(advise(flat, NEWTON, frames=3, resolutions={"fine": fine, "away": away}))
    assert found["fine"].change < 1e-6 and found["away"].change == pytest.approx(0.25, rel=1e-6)

    def chain(n):
        return wc.Scene(wc.Mesh.chain(n), density=0.1, terms=[wc.Spring(stiffness=100.0)], pins=[0], duration=0.1)

    found = by_name(advise(chain(4), NEWTON, frames=3, resolutions={"longer": chain(8)}))
    assert found["longer"].matters is None and "edges alone" in found["longer"].reason


def test_what_cannot_run_is_said_and_not_called_needless():
    """Without the spring the other scene has nothing that Newton takes; diverging without a term is to matter."""
    scene = hanging.scene(n=5, stiffness=1e6)
    found = by_name(advise(scene, wc.Explicit(substeps=400, above_limit="allow"), frames=3))
    assert found["substeps=800"].matters is not None
    with pytest.raises(ValueError, match="advice needs a run that does not diverge"):
        advise(scene, wc.Explicit(substeps=4, above_limit="allow"), frames=3)


# One step and sweep a frame, which on `hanging` end farther than half an edge from the solution.
LONG = wc.XPBD(substeps=1, iterations=1)


def test_runs_that_are_not_usable_are_compared_and_marked(capsys):
    found = advise(hanging.scene(n=16), LONG, frames=10, resolutions={"n=4": hanging.scene(n=4)})
    assert not found.status.ok and found.sentences[0].startswith("the scene as it is: not usable: in frame 6 ")
    trials = by_name(found)
    assert trials["float32"].usable is False and trials["float32"].matters is False
    assert trials["n=4"].usable and trials["n=4"].reason == ""  # its edges are four times as long
    words = "info hanging -p n=16 --advise --solver xpbd -s substeps=1 iterations=1 --frames 10".split()
    assert main(words) == 0
    assert "does not matter: not usable: in frame 6 " in capsys.readouterr().out
    assert main([*words, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["usable"] is False and [trial["usable"] for trial in facts["trials"] if trial["name"] == "float32"] == [False]


def test_what_keeps_a_run_usable_is_not_called_needless():
    """Without what holds the cloth it falls, which the steps are too long for, however little that changes."""
    held = replace(hanging.scene(n=16), terms=[*hanging.scene(n=16).terms, wc.Attachment(vertices="all", stiffness=1e3)])
    found = advise(held, LONG, tolerance=10.0, frames=10)
    trial = by_name(found)["without Attachment"]
    assert found.status.ok and trial.matters is False and trial.usable is False
    assert any(sentence.startswith("without QuadraticBending changes") for sentence in found.sentences)
    assert not any(sentence.startswith("without Attachment changes") for sentence in found.sentences)


def held_twice(n=5):
    """A cloth whose pins are soft and there twice, either of which would do."""
    pins = [wc.Attachment(vertices=[0, n - 1], stiffness=1e5) for _ in range(2)]
    terms = [wc.Spring(pairs=("structural", "shear"), stiffness=1e3), *pins]
    return wc.Scene(wc.Mesh.grid(n, n), density=0.1, terms=terms, duration=1.0)


def test_terms_that_stand_in_for_one_another_are_not_both_left_out():
    found = advise(held_twice(), NEWTON, frames=10)
    trials = by_name(found)
    one, other = (trials[f"without Attachment {k} of 2"] for k in (1, 2))
    both = trials["without Attachment 1 of 2 and Attachment 2 of 2"]
    assert one.matters is other.matters is False and both.matters and both.kind == "all"
    assert not any("leave it out" in sentence for sentence in found.sentences)
    assert any("leave one out, and try again" in sentence for sentence in found.sentences)
    # Where none matters with the others left out too, all may be.
    idle = replace(held_twice(), pins=[0, 4])
    assert by_name(advise(idle, NEWTON, frames=10))["without Attachment 1 of 2 and Attachment 2 of 2"].matters is False


def test_colliders_and_friction_matter_where_cloth_slides():
    """A sheet on a slope of 30°: without friction of 0.2 it slides √(3)·0.2/2/(1/2) = 35 % further, without the slope it falls.

    A ball far away does nothing, nor does its friction.
    """
    scene = incline.scene(n=4, friction=0.2, duration=0.25)
    ball = wc.Sphere(radius=0.1, position=(0.0, -5.0, 0.0), friction=0.5, name="ball")
    found = advise(replace(scene, colliders=[*scene.colliders, ball]), wc.Newton(substeps=4), tolerance=0.05)
    trials = by_name(found)
    assert [trial.kind for trial in found.trials[:7]] == ["term", "term", *["collider", "friction"] * 2, "all"]
    assert trials["without the collider slope"].matters and trials["without friction on slope"].matters
    for name in ("the collider ball", "friction on ball"):
        assert trials[f"without {name}"].change < 1e-9 and trials[f"without {name}"].matters is False
    said = [sentence for sentence in found.sentences if " ball " in sentence]
    assert said == [said[0]] and "without the collider ball changes the result by 0.00% alone" in said[0]
    # Of s = ½at² at 15 frames, relative to the side of 0.2 m, root mean square over 16 frames.
    g, times = 9.81, np.arange(16) / 60.0
    expected = 0.5 * g * 0.2 * np.sqrt(0.75) * np.sqrt((times**4).mean()) / 0.2
    assert trials["without friction on slope"].change == pytest.approx(expected, rel=0.05)


def test_air_and_anisotropy_matter_where_they_do_something():
    """Wind of 5 m/s lifts a cloth that otherwise hangs; a stiffness of weft that nothing loads changes nothing."""
    mesh = wc.Mesh.grid(4, 4, size=0.3, pattern="alternating")
    # Pulled by its weight along z, the weft; without texture coordinates directions are given.
    membrane = wc.OrthotropicMembrane(stiffness=100.0, weft_ratio=0.1, warp=(1.0, 0.0, 0.0))
    plate = wc.PlateBending(stiffness=1e-6, weft_ratio=2.0, warp=(1.0, 0.0, 0.0))
    hung = mesh.points[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    wind = wc.Air(wind=(0.0, 0.0, 5.0))
    scene = wc.Scene(mesh, density=0.2, positions=hung, terms=[membrane, plate], pins="z == 0", air=wind, duration=0.2)
    trials = by_name(advise(scene, wc.Newton(substeps=2), tolerance=1e-3))
    assert trials["without the air"].matters and trials["without the air"].change > 0.05
    assert trials["without the anisotropy of OrthotropicMembrane"].matters
    assert trials["without the anisotropy of PlateBending"].matters is False
    even = replace(scene, air=None, terms=[membrane.isotropic(), plate.isotropic()])
    assert not any("air" in name or "anisotropy" in name for name in by_name(advise(even, wc.Newton(substeps=2), frames=2)))
    assert membrane.isotropic().stiffness == pytest.approx(100.0 * np.sqrt(0.1))


def test_frames_that_were_not_run_are_said():
    """A limit that the cloth meets after 10 frames does not matter before, and is not said to be needless for good."""
    scene = hanging.scene(n=5)
    late = [*scene.terms[:1], wc.SpringLimit(pairs=[(0, 24)], most=1.2, stiffness=1e3)]
    short, whole = (advise(replace(scene, terms=late), NEWTON, frames=frames) for frames in (6, 60))
    assert by_name(short)["without SpringLimit"].matters is False
    assert any("only 6 of 60 frames were run" in sentence for sentence in short.sentences)
    assert not any("frames were run" in sentence for sentence in whole.sentences)


def test_a_finer_mesh_that_diverges_is_not_called_for():
    """The step of explicit is that of the scene; what is finer is told by its vertices, not by its time."""
    record = wc.Explicit(substeps=16, above_limit="allow")
    others = {"n=4": hanging.scene(n=4), "n=12": hanging.scene(n=12)}
    found = advise(hanging.scene(n=4), record, frames=3, resolutions=others)
    trials = by_name(found)
    assert trials["n=12"].matters is None and trials["n=12"].finer and trials["n=4"].finer is False
    assert any(s.startswith("n=12: diverged in frame") for s in found.sentences)
    assert not any("too coarse" in s or "inf" in s for s in found.sentences)


def test_the_command(capsys):
    command = ["info", "hanging", "-p", "n=6", "--solver", "newton", "-s", "substeps=4", "--advise"]
    assert main([*command, "--frames", "5", "--tolerance", "1%"]) == 0
    said = capsys.readouterr().out
    assert "without QuadraticBending" in said and "n=12" in said and "advice:" in said
    assert main([*command, "--frames", "2", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    kinds = [trial["kind"] for trial in facts["trials"]]
    assert kinds == ["term", "term", "all", "precision", "step", "resolution", "resolution"]  # 2 frames need neither term
    assert [trial["finer"] for trial in facts["trials"]] == [None] * 5 + [False, True]
    assert facts["tolerance"] == 0.01
    assert facts["dtype"] == "float64" and facts["trials"][3]["name"] == "float32"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--tolerance 1%", "--tolerance is given without --advise"),
        ("--frames 3", "--frames is given without --advise"),
        ("--advise --tolerance much", "tolerance"),
        ("--advise --tolerance 2", "tolerance is 2, 2 times the whole"),
        ("--advise --tolerance 0%", "tolerance is 0.0; it must be a number above 0"),
        ("--advise --frames 0", "frames is 0"),
    ],
)
def test_wrong_use(words, said, capsys):
    assert main(["info", "hanging", "-p", "n=4", *words.split()]) == 2
    assert said in capsys.readouterr().err
