"""Pictures in 3D and films: what is handed to the drawing is the scene on any number of ranks, and no run loses its film.

Worth reading first: ``test_outside_of_the_bodies`` and ``test_run_that_breaks``.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import traceback
import types
from functools import partial
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from helpers import raised, refused
from results_scenes import pressed

import uem_dolfinx as uem
from uem_dolfinx.output import drawings, films, pictures, pictures3d
from uem_dolfinx.output import frames as frames_module

mpl_image = pytest.importorskip("matplotlib.image")
COMM = MPI.COMM_WORLD


def need_pyvista():
    pytest.importorskip("pyvista")


@pytest.fixture
def drawn(monkeypatch):
    """What PyVista would draw on rank 0, as keyword arguments; nothing is drawn."""
    calls = []

    def images(faces, solids, look):
        solid = solids[0]
        calls.append(dict(x=solid.points, faces=faces, values=solid.values, box=look.box, cut=look.cut, view=look.view))
        calls[-1] |= dict(arrows=solid.arrows, cuts=solid.cuts, rigid=solid.rigid)
        return [np.zeros((2, 3, 4), np.uint8) for _ in solids]

    monkeypatch.setattr(pictures3d, "images", images)
    monkeypatch.setattr(pictures3d, "require", lambda comm: None)
    return calls


def area(x, faces):
    """Area of plane facets."""
    a = x[faces]
    return 0.5 * np.linalg.norm(sum(np.cross(a[:, i] - a[:, 0], a[:, i + 1] - a[:, 0]) for i in range(1, a.shape[1] - 1)), axis=1)


@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
def test_outside_of_the_bodies(cell, drawn, folder):
    """Two unit cubes, one on the other: their 12 sides, each with its displacement, and the pressure where they meet."""
    problem = pressed(COMM, cell, 2 if cell == "tetrahedron" else 1)
    contact = problem.contacts[0]
    uem.plot_scene(problem, folder / "start.png")
    for _ in uem.load_steps(problem):
        pass
    uem.plot_scene(problem, folder / "end.png", levels=[0.0, 0.05, 0.1], view=(0.0, 0.0, 2.0))
    uem.plot_scene(problem, folder / "pressure.png", field=contact, surface=contact.contactor, levels=[0.0, 1.0], arrows=True)
    force = contact.resultant().force[2]
    X = problem.config.X[contact.nodes]
    np.testing.assert_allclose(contact.points - X, problem.u.x.array.reshape(-1, 3)[contact.nodes], atol=1e-14)
    if COMM.rank:
        assert not drawn
        return
    start, end, pressure = drawn
    assert area(start["x"], start["faces"]).sum() == pytest.approx(12.0)
    assert not end["cut"] and area(end["x"], end["faces"]).sum() == pytest.approx(8.0 - 4.0 * 0.1 + 4.0)
    np.testing.assert_allclose(end["box"], [[0, 1], [0, 1], [-1, 0.9]], atol=4 * drawings.EVEN)
    # colours are numbered from 0; |u| grows from the bottom to the top
    top = np.isclose(end["x"][:, 2], 0.9)
    np.testing.assert_allclose(end["values"][top], 2.0)
    np.testing.assert_allclose(end["values"], 20.0 * 0.05 * (end["x"][:, 2] + 1.0) / 0.95, atol=1e-9)
    np.testing.assert_allclose(end["view"], [0, 0, 1])
    assert area(pressure["x"], pressure["faces"]).sum() == pytest.approx(1.0)
    np.testing.assert_allclose(pressure["values"], force, rtol=1e-7)
    # of even pressure: an eighth of the side, upwards like the force on the upper cube
    at, arrows = pressure["arrows"]
    assert len(at) == len(arrows) > 0 and not len(end["arrows"][0])
    np.testing.assert_allclose(arrows, np.tile([0.0, 0.0, 0.125], (len(at), 1)), atol=1e-9)


@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
@pytest.mark.slow
def test_a_window_cuts_bodies(cell, drawn, folder):
    """Both cubes at x = 0.5, 1 by 1.9, and the field is drawn there."""
    need_pyvista()
    problem = pressed(COMM, cell, 2 if cell == "tetrahedron" else 1)
    for _ in uem.load_steps(problem):
        pass
    uem.plot_scene(problem, folder / "part.png", levels=[0.0, 0.05, 0.1], window=(0.0, 0.5, 0.0, 1.0, 0.0, 1.0))
    if COMM.rank:
        return
    (part,) = drawn
    np.testing.assert_allclose(part["box"], [[0, 0.5], [0, 1], [0, 1]], atol=2 * drawings.EVEN)
    assert (part["box"][:, 0] < 0).all() and part["cut"]
    corners, inside = part["cuts"]
    middle = np.isclose(corners[:, :, 0], 0.5).all(axis=1)
    assert area(corners[middle].reshape(-1, 3), np.arange(3 * middle.sum()).reshape(-1, 3)).sum() == pytest.approx(1.9)
    np.testing.assert_allclose(inside[middle], 20.0 * 0.05 * (corners[middle][:, :, 2] + 1.0) / 0.95, atol=1e-7)


def test_rigid_surfaces(folder):
    """Are drawn where they have been moved to when the frame is taken, behind their surface, and each once."""
    ball = uem.RigidSphere((0.0, 0.0, 2.0), 1.0).move((0.0, 0.0, -0.5))
    shapes = frames_module.rigid_shapes([types.SimpleNamespace(target=target) for target in (ball, "a tag", ball)])
    ball.move((0.0, 0.0, 7.0))
    axes, points = frames_module.grid(np.array([[-1.0, 1.0], [-2.0, 2.0], [0.0, 3.0]]), 20)
    assert [len(x) for x in axes] == [12, 22, 17] and len(shapes) == 1
    np.testing.assert_allclose(points[:12, 0], axes[0])
    behind = np.linalg.norm(points - [0.0, 0.0, 1.5], axis=1) < 1.0
    np.testing.assert_array_equal(shapes[0].height(points) < 0, behind)


def test_colours():
    """Grey where there is no pressure, whose colours begin above 0; a few large values do not take all colours."""
    values = np.concatenate([np.zeros(100), np.linspace(0.0, 1.0, 899), [50.0]])
    frame = frames_module.Frame(np.zeros((1000, 2)), values, [], ("", 0.0), (np.zeros((0, 3, 3)), np.zeros((0, 3))), [])

    def drawn(**how):
        known = dict(levels=10, window=None, mirror=False, percentiles=None, pressed=False, cmap="viridis")
        return drawings.Drawn2D(
            types.SimpleNamespace(**(known | how)), types.SimpleNamespace(faces=np.zeros((0, 3), int)), [frame]
        )

    pressed, most = drawn(pressed=True), drawn(percentiles=(0.0, 99.0))
    assert pressed.extend == "min" and 0 < pressed.bounds[0] <= drawings.EVEN * 50.0
    assert pressed.cmap(-1.0)[:3] == pytest.approx([210 / 255] * 3)
    assert most.extend == "max" and 0.9 < most.bounds[-1] < 1.2 and drawn().bounds[-1] >= 50.0
    assert drawn(levels=[0.0, 1.0], pressed=True).extend == "both" and drawn(levels=[0.0, 60.0]).extend == "neither"


def test_titles_of_frames():
    """Digits enough to tell states apart, and a step's name before its load."""
    assert films.titles([("time", 0.1234), ("time", 0.5)]) == ["time 0.123", "time 0.5"]
    assert films.titles([("time", 12.3451), ("time", 12.3462)]) == ["time 12.345", "time 12.346"]
    assert films.titles([("press, load", 1.0), ("pull, load", 1.0)]) == ["press, load 1", "pull, load 1"]
    assert films.titles([("", 0.0)] * 2) == ["0", "0"]


@pytest.mark.slow
def test_pictures_of_bodies(folder):
    """Drawn in fact, into a file and into a panel: the scene is on it, in the colours of the colour map."""
    need_pyvista()
    problem = pressed(COMM, "tetrahedron")
    uem.plot_scene(problem, folder / "scene.png", cells=False)
    with uem.figure(folder / "both.png", COMM, panels=2) as (left, right):
        uem.plot_scene(problem, left, field=ufl.div(problem.u), window=(0, 0.5, 0, 1, -1, 1), view="iso")
        uem.plot_pressure(problem.contacts, right)
        if left is not None:
            image = left.get_images()[0].get_array()
            assert (image[..., 3] > 0).mean() > 0.3 and image.shape[0] > 500
    raised(uem.InputError, "no part of the scene is in it", lambda: uem.plot_scene(problem, folder / "a.png", window=(5, 6) * 3))
    raised(ValueError, "no such colours", lambda: uem.plot_scene(problem, folder / "a.png", cmap="no such colours"))


def test_arguments_of_other_dimensions(monkeypatch, folder):
    monkeypatch.setattr(pictures3d, "require", lambda comm: None)
    flat, solid = pressed(COMM, "triangle"), pressed(COMM, "tetrahedron")
    given = {
        "mirror": True, "window": (0, 1, 0, 1), "view": (0, 0, 0), "field": solid.u, "levels": [1.0, 0.0],
        "percentiles": (50, 120), "dpi": 0, "size": (1.0,),
    }  # fmt: skip
    for name, value in given.items():
        refused(uem.InputError, name, lambda name=name, value=value: uem.plot_scene(solid, folder / "a.png", **{name: value}))
    for name, value in {
        "view": "iso",
        "surface": flat.contacts[0].contactor,
        "window": (1, 0, 0, 1),
        "levels": 0,
        "field": [],
    }.items():
        refused(uem.InputError, name, lambda name=name, value=value: uem.plot_scene(flat, folder / "a.png", **{name: value}))
    for how in (
        {"levels": 257},
        {"levels": range(300)},
        {"size": (1e6, 1e6)},
        {"size": (1e-9, 1.0)},
        {"dpi": 1e7},
        {"dpi": 1e-9},
    ):
        expected = "256 colours" if "levels" in how else "16384 on a side"
        refused(uem.InputError, expected, lambda how=how: uem.plot_scene(flat, folder / "a.png", **how))
    refused(uem.InputError, "a point in each panel", lambda: uem.figure(folder / "a.png", COMM, 10**7).__enter__())
    refused(uem.InputError, "16384 on a side", lambda: uem.figure(folder / "a.png", COMM, 400, size=(50, 50)).__enter__())
    refused(uem.InputError, "16384 on a side", lambda: uem.animate(folder / "a.gif", flat, [], size=(1e6, 1e6)))
    refused(uem.InputTypeError, "picture = 3", lambda: uem.plot_scene(flat, 3))
    for name in ("mirror", "cells", "arrows", "rigid", "triad"):
        draw = partial(uem.plot_scene, flat, folder / "a.png", **{name: "no"})
        refused(uem.InputTypeError, (f"{name} = 'no'", "True or False"), draw)
    refused(
        uem.InputTypeError, ("mirror = 1", "True or False"), lambda: uem.plot_pressure(flat.contacts, folder / "a.png", mirror=1)
    )


def test_no_pyvista_is_a_named_error_on_every_rank(monkeypatch, folder):
    if COMM.rank == 0:
        monkeypatch.setitem(sys.modules, "pyvista", None)
    problem = pressed(COMM, "tetrahedron")
    raised(uem.MissingBackendError, "needs PyVista .*pip install pyvista", lambda: uem.plot_scene(problem, folder / "a.png"))
    steps = uem.load_steps(problem)
    raised(uem.MissingBackendError, "needs PyVista", lambda: uem.animate(folder / "a.gif", problem, steps))


def test_nothing_to_draw_with(monkeypatch, folder):
    """VTK would end the process."""
    monkeypatch.setitem(sys.modules, "pyvista", types.ModuleType("pyvista"))
    monkeypatch.delenv("DISPLAY", raising=False)
    if COMM.rank == 0:
        monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    refused(
        uem.MissingBackendError, ("libEGL", "apt-get"), lambda: uem.plot_scene(pressed(COMM, "tetrahedron"), folder / "a.png")
    )


def test_a_pressure_that_is_the_same_everywhere(folder):
    """Is drawn with room above, not on the frame."""
    problem = pressed(COMM, "triangle")
    for _ in uem.load_steps(problem):
        pass
    largest = problem.contacts[0].max_pressure()
    with uem.figure(folder / "pressure.png", COMM) as (panel,):
        uem.plot_pressure(problem.contacts, panel)
        if panel is not None:
            assert 0.9 * panel.get_ylim()[1] < largest < 0.97 * panel.get_ylim()[1] and panel.get_ylim()[0] == 0


def test_a_field_that_is_the_same_everywhere():
    """Rounding is not drawn, and what varies a little more is."""
    assert drawings._bounds(2.0, 2.0 * (1 + 3e-10), 12).tolist() == pytest.approx([1.9, 2.1])
    assert len(drawings._bounds(2.0, 2.0 * (1 + 3e-9), 12)) > 6
    assert len(drawings._bounds(0.0, 0.0, 12)) == 2


# -- films -----------------------------------------------------------------------------------------------------------------


def frames(path):
    """How many frames a film has, by rank 0."""
    from PIL import Image

    COMM.barrier()
    return COMM.bcast(Image.open(path).n_frames if COMM.rank == 0 else None)


@pytest.mark.long
def test_frames_of_a_film(folder, monkeypatch):
    """One for each step, all with the same window and the same colours, and the steps come as they would."""
    problem, bounds = pressed(COMM, "triangle"), []
    draw = drawings.Drawn2D.draw

    def seen(self, ax, frame):
        draw(self, ax, frame)
        bounds.append((*ax.get_xlim(), *ax.get_ylim(), *self.bounds))

    monkeypatch.setattr(drawings.Drawn2D, "draw", seen)
    field = 100.0 * problem.contacts[0].pressure
    steps = list(uem.animate(folder / "new" / "a.gif", problem, uem.load_steps(problem, 4), field=field, label="pressure"))
    assert [step.factor for step in steps] == [0.25, 0.5, 0.75, 1.0] and frames(folder / "new" / "a.gif") == 4
    assert len(bounds) == 4 * (COMM.rank == 0) and len(set(bounds)) == COMM.allreduce(len(set(bounds))) * (COMM.rank == 0)


@pytest.mark.slow
def test_every_second_step_in_3d(folder):
    need_pyvista()
    problem = pressed(COMM, "hexahedron")
    assert len(list(uem.animate(folder / "a.gif", problem, uem.load_steps(problem, 3), every=2, field=problem.contacts))) == 3
    assert frames(folder / "a.gif") == 2


def broken(steps):
    """Steps of which the third fails."""
    for number, step in enumerate(steps):
        if number == 2:
            raise uem.ConvergenceError("no third step")
        yield step


def test_run_that_breaks(folder, caplog, monkeypatch):
    """Its film has the steps before, and its exception is what it was, even if the film cannot be drawn."""
    problem = pressed(COMM, "triangle")
    run = lambda: list(uem.animate(folder / "a.gif", problem, broken(uem.load_steps(problem, 4))))  # noqa: E731
    error = raised(uem.ConvergenceError, "no third step", run)
    assert "broken" in [entry.name for entry in traceback.extract_tb(error.__traceback__)]
    assert frames(folder / "a.gif") == 2
    monkeypatch.setattr(films, "_write", lambda *args: 1 / 0)
    problem = pressed(COMM, "triangle")
    raised(uem.ConvergenceError, "no third step", run)
    assert "a.gif cannot be written (ZeroDivisionError" in caplog.text or COMM.rank


def test_loop_that_is_left(folder):
    """By ``break``, by an exception, and before its first step, which leaves no film."""
    problem = pressed(COMM, "triangle")
    for step in uem.animate(folder / "a.gif", problem, uem.load_steps(problem, 4)):
        if step.factor > 0.6:
            break
    assert frames(folder / "a.gif") == 3
    problem = pressed(COMM, "triangle")

    def run():
        for _ in uem.animate(folder / "b.gif", problem, uem.load_steps(problem, 4)):
            raise ZeroDivisionError("in the loop")

    raised(ZeroDivisionError, "in the loop", run)
    assert frames(folder / "b.gif") == 1
    uem.animate(folder / "c.gif", problem, uem.load_steps(problem, 4)).close()
    COMM.barrier()
    assert not (folder / "c.gif").exists()


@pytest.mark.slow
def test_films_by_ffmpeg(folder):
    """As many frames as steps were drawn."""
    pytest.importorskip("matplotlib")
    if COMM.bcast(shutil.which("ffprobe")) is None:
        pytest.skip("needs ffmpeg")
    problem = pressed(COMM, "triangle")
    for _ in uem.animate(folder / "a.mp4", problem, uem.load_steps(problem, 4), frames_per_second=5):
        pass
    if COMM.rank == 0:
        requested = ["-v", "error", "-count_frames", "-show_entries", "stream=nb_read_frames,r_frame_rate", "-of", "csv=p=0"]
        reported = subprocess.run(
            ["ffprobe", *requested, str(folder / "a.mp4")], check=True, capture_output=True, text=True
        ).stdout
        assert reported.split() == ["5/1,4"]


def test_films_that_are_refused(folder, monkeypatch):
    """Before the run."""
    problem = pressed(COMM, "triangle")

    def film(name, **how):
        return lambda: uem.animate(folder / name, problem, uem.load_steps(problem, 4), **how)

    refused(uem.InputError, ("path", ".gif or .mp4", "a.png"), film("a.png"))
    refused(uem.InputError, ("labl", "did you mean 'label'"), film("a.gif", labl="stress"))
    refused(uem.InputError, "every = 0", film("a.gif", every=0))
    refused(uem.InputError, "view", film("a.gif", view="iso"))
    monkeypatch.setenv("PATH", "")
    refused(uem.MissingBackendError, "needs ffmpeg", film("a.mp4"))
    if COMM.rank == 0:
        (folder / "out").write_text("in the way")
    COMM.barrier()
    refused(uem.OutputError, "cannot be written", film(Path("out") / "a.gif"))


@pytest.mark.slow
def test_panels_and_their_letters(folder):
    """A picture is no wider than a page, and notes where its panels are; they do not overlap and hold all that is drawn."""
    pytest.importorskip("PIL")
    from PIL import Image

    for count, columns in ((1, None), (2, None), (3, None), (3, 2), (2, 1)):
        path = folder / f"panels_{count}_{columns}.png"
        with uem.figure(path, COMM, panels=count, columns=columns) as panels:
            for panel in panels:
                if panel is not None:
                    panel.set(xlabel="time", ylabel="force")
        if COMM.rank == 0:
            image = Image.open(path)
            assert image.width <= 150 * (pictures.PAGE + 2 * pictures.MARGIN)
            boxes = np.array([[int(end) for end in one.split(",")] for one in image.info["Panels"].split()])
            assert len(boxes) == count and (boxes[:, :2] < boxes[:, 2:]).all()
            ink, held = np.array(image.convert("L")) < 128, np.zeros((image.height, image.width), dtype=int)
            for left, top, right, bottom in boxes:
                held[top - 2 : bottom + 2, left - 2 : right + 2] += 1
            assert held.max() == 1 and (held[ink] == 1).all()
    # a panel that the script takes away
    with uem.figure(folder / "none.png", COMM) as (panel,):
        if panel is not None:
            panel.figure.text(0.5, 0.5, "own drawing")
            panel.remove()
    raised(uem.InputError, "columns", lambda: uem.figure(folder / "a.png", COMM, columns=0).__enter__())


@pytest.mark.long
@pytest.mark.parametrize("wide", [False, True])
def test_colour_bars_are_as_long_as_the_scene(folder, wide):
    """To the right of a scene, above it if it is flat, although the panel has another shape."""
    problem = pressed(COMM, "triangle")
    window = (-5.0, 5.0, 0.0, 2.0) if wide else (0.0, 0.5, 0.0, 2.0)
    with uem.figure(folder / "bar.png", COMM, size=(5.0, 4.0)) as (panel,):
        uem.plot_scene(problem, panel, window=window)
        if panel is not None:
            panel.figure.draw_without_rendering()
            scene, bar = panel.get_window_extent(), panel.child_axes[0].get_window_extent()
            assert (bar.width if wide else bar.height) == pytest.approx(scene.width if wide else scene.height)
            assert bar.y0 > scene.y1 if wide else bar.x0 > scene.x1
    if COMM.rank == 0:
        # nothing is cut off
        assert (mpl_image.imread(folder / "bar.png")[[0, -1], :, :3] > 0.99).all()


def test_cells_larger_than_the_window_have_their_colour(folder):
    """All of a window is coloured, although the values at its only vertex are no more than one."""
    problem = pressed(COMM, "triangle")
    every = np.concatenate(COMM.allgather(problem.config.X))
    x, y = every[np.linalg.norm(every - [0.5, 0.5], axis=1).argmin()]
    across = ufl.SpatialCoordinate(problem.config.mesh)[0]
    with uem.figure(folder / "near.png", COMM) as (panel,):
        window = (x - 0.05, x + 0.05, y - 0.05, y + 0.05)
        uem.plot_scene(problem, panel, field=across, window=window, cells=False, arrows=False)
        if panel is not None:
            panel.figure.canvas.draw()
            box = panel.get_window_extent()
            pixels = np.asarray(panel.figure.canvas.buffer_rgba())[::-1]
            inner = pixels[int(box.y0) + 5 : int(box.y1) - 5, int(box.x0) + 5 : int(box.x1) - 5, :3]
            assert (inner.min(axis=2) < 250).all()
