"""Return of solvers to their state of the last accepted step, with the factorisations that a refused step has replaced."""

from __future__ import annotations

from typing import Any, ClassVar


class Returning:
    """An object whose attributes ``commit`` keeps and ``restore`` brings back.

    A PETSc object that ``commit`` has kept is neither changed nor destroyed until another is kept: memory holds both, if a step makes
    another one, until it is accepted or refused.
    """

    #: Name of the attribute with a PETSc object; empty without one.
    made: ClassVar[str] = ""
    #: Names of attributes that are of the same kind, and of those that ``restore`` does not bring back.
    parts: ClassVar[tuple[str, ...]] = ()
    stays: ClassVar[tuple[str, ...]] = ()
    #: Attributes at the end of the last accepted step.
    _last: dict[str, Any] | None = None

    def commit(self) -> None:
        """Keep the present attributes (collective)."""
        last, self._last = self._last, None
        if self.made and last is not None and last[self.made] is not self.__dict__[self.made]:
            _destroy(last[self.made])
        self._last = {name: value for name, value in self.__dict__.items() if name not in self.stays}
        del self._last["_last"]
        for part in self.parts:
            self.__dict__[part].commit()

    def restore(self) -> None:
        """Bring back the attributes that ``commit`` has kept (collective)."""
        assert self._last is not None
        self.lose()
        self.__dict__.update(self._last)
        for part in self.parts:
            self.__dict__[part].restore()

    @property
    def keeps(self) -> bool:
        """Whether the present PETSc object is that of the last accepted step."""
        return self._last is not None and self._last[self.made] is self.__dict__[self.made]

    def lose(self) -> None:
        """Destroy the present PETSc object, unless it is kept (collective)."""
        if self.made and not self.keeps:
            _destroy(self.__dict__.get(self.made))


def _destroy(made: Any) -> None:
    if made is not None:
        # garbage would keep factors until the next iteration
        made.destroy()
