"""Films of runs: data are collected at each step and drawn at the end of the run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from uem_dolfinx import given
from uem_dolfinx.errors import InputError, MissingBackendError, OutputError
from uem_dolfinx.files import REMEDY, on_rank_0
from uem_dolfinx.log import logger
from uem_dolfinx.output.drawings import Drawing, checked_size
from uem_dolfinx.output.frames import Frame
from uem_dolfinx.output.pictures import new_canvas, plot_scene
from uem_dolfinx.output.tables import given_path
from uem_dolfinx.parallel import agreed
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.stepping import LoadStep, TimeStep

T = TypeVar("T")


def animate(
    path: str | Path,
    problem: UnitedProblem,
    steps: Iterable[T],
    *,
    every: int = 1,
    frames_per_second: float = 12,
    size: tuple[float, float] = (6.4, 4.8),
    **how: Any,
) -> Iterator[T]:
    """Yield the steps of a run and make a film of them, as pictures of :func:`plot_scene` (collective).

    All frames have the same window, colours and lengths of arrows, and a title with the load factor or time, with enough digits to
    distinguish them::

        for step in uem.animate("out/snap.gif", problem, uem.load_steps(problem, 20), field=stress, label="stress"):
            ...

    The film is written when the run has ended, also by an exception, a signal, or ``break``. Errors while writing the film then
    become warnings, so that the original exception is kept. If you leave the loop with ``break``, close the iterator or keep no
    reference to it.

    Args:
        path: name of the film, which ends in ``.gif`` or ``.mp4``; its folder is made.
        problem: the problem.
        steps: ``load_steps`` or ``time_steps`` of the problem, or another iterator that solves steps.
        every: draw every n-th step, starting with the first.
        frames_per_second: speed of the film.
        size: width and height in inches, of 100 points each.
        how: arguments of :func:`plot_scene`. A Function in an expression is evaluated at each step; pass a contact to draw its
            pressure at each step.

    Returns:
        An iterator over the same steps.

    Raises:
        InputError, InputTypeError: for another ending, or an argument that ``plot_scene`` does not have or refuses.
        MissingBackendError: before the run, if matplotlib, in 3D PyVista, or for ``.mp4`` ffmpeg is missing.
        OutputError: if the film cannot be written: before the run if its folder cannot be made, or at its end.
    """
    path = given_path("path", path, problem.comm)
    with agreed(problem.comm):
        if path.suffix not in (".gif", ".mp4"):
            raise InputError(given.sentence("path", str(path), "a name that ends in .gif or .mp4"))
        given.kind("steps", steps, hasattr(steps, "__iter__"), "steps, as load_steps(problem, 20)")
        every = given.count("every", every)
        size = checked_size(size, 100)
        rate = given.number("frames_per_second", frames_per_second, given.POSITIVE)
        known = {name: value for name, value in (plot_scene.__kwdefaults__ or {}).items() if name not in ("size", "dpi")}
        for name in how:
            given.word("argument of animate", name, ("every", "frames_per_second", "size", *known))
    given.alike(problem.comm, "animate", every=every, frames_per_second=rate, size=size)
    on_rank_0(problem.comm, f"the film {path} cannot be written", lambda: _prepare(path))
    return _film(path, Drawing(problem, **(known | how)), steps, every, rate, size)


def _film(path: Path, drawing: Drawing, steps: Iterable[T], every: int, rate: float, size: tuple[float, float]) -> Iterator[T]:
    """The steps of ``animate``."""
    frames: list[Frame | None] = []
    try:
        for number, step in enumerate(steps):
            if number % every == 0:
                frames.append(drawing.take(_state(number, step)))
            yield step
    except BaseException:
        # ranks may leave the loop at different times, so that nothing here may be collective
        try:
            _write(path, drawing, frames, rate, size)
        except Exception as error:
            logger.warning("the film %s cannot be written (%s: %s)", path, type(error).__name__, error)
        raise
    with agreed(drawing.comm):
        try:
            _write(path, drawing, frames, rate, size)
        except OSError as error:
            raise OutputError(f"the film {path} cannot be written ({error}): {REMEDY}") from error


def _state(number: int, step: object) -> tuple[str, float]:
    """Label of the state after a step: a word and a number."""
    if isinstance(step, TimeStep):
        return "time", step.time
    if isinstance(step, LoadStep):
        return f"{step.step}, load" if step.step else "load", step.factor
    return "step", number + 1


def titles(states: list[tuple[str, float]]) -> list[str]:
    """Words and numbers of states, with at least three digits, and enough to distinguish different states."""
    for digits in range(3, 17):
        found = [f"{word} {number:.{digits}g}".strip() for word, number in states]
        if len(set(found)) == len(set(states)):
            break
    return found


def _prepare(path: Path) -> None:
    """Check, before the run, that its film can be drawn and written."""
    new_canvas(f"the film {path}", (1.0, 1.0))
    from matplotlib.animation import FFMpegWriter

    if path.suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise MissingBackendError(f"the film {path} needs ffmpeg, which is missing: install it, or write a .gif")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab"):
        pass
    if not path.stat().st_size:
        path.unlink()


def _write(path: Path, drawing: Drawing, frames: list[Frame | None], rate: float, size: tuple[float, float]) -> None:
    """Draw the frames and write the film, on rank 0."""
    taken = [frame for frame in frames if frame is not None]
    if not taken:
        return
    from matplotlib.animation import FFMpegWriter, PillowWriter

    canvas = new_canvas(f"the film {path}", size)
    # smaller than a picture
    drawn = drawing.over(taken, round(1.25 * 100 * size[0]))
    writer = (PillowWriter if path.suffix == ".gif" else FFMpegWriter)(fps=rate)
    with writer.saving(canvas, str(path), 100):
        for frame, title in zip(taken, titles([frame.state for frame in taken])):
            canvas.clear()
            ax = canvas.subplots()
            drawn.draw(ax, frame)
            ax.set_title(title)
            writer.grab_frame()
