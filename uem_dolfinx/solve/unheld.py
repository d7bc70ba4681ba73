"""Which body a field has flown off on where nothing holds it: rigid motions of bodies are looked at before they fly, other fields after."""

from __future__ import annotations

import numpy as np

from uem_dolfinx import compat
from uem_dolfinx.errors import FloatingBodyError
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.geometry.nodes import described
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.bodies import Bodies


def unheld(bodies: Bodies, field: int, residual: float) -> FloatingBodyError:
    """What to tell about a field that is solved for and grows without end: on which body it is largest (collective).

    Args:
        bodies: where it is as large as it became.
        field: its number among the fields of a mixed problem, the displacement's 0; else 0.
        residual: part of the forces that its equations leave.
    """
    config, comm, values = bodies.config, bodies.comm, np.abs(bodies.u.x.array)
    if config.unknowns.mixed:
        values = np.where(config.unknowns.field_of == field, values, 0.0)
    most = values.max(initial=0.0)
    largest, rank = max((value, -r) for r, value in enumerate(comm.allgather(most)))
    body, _ = find_bodies(config)
    where = -1
    if comm.rank == -rank:
        unknown = int(values.argmax())
        node = unknown if config.unknowns.mixed else unknown // config.block
        cells, _ = np.nonzero(compat.cell_dofs(bodies.u.function_space) == node)
        where = int(body[compat.cell_dofs(config.V)[cells[0], 0]])
    where = comm.bcast(where, root=-rank)
    here = config.X[: config.n_owned][body[: config.n_owned] == where]
    sums = reduced(comm, np.append(here.sum(axis=0), float(len(here))))
    name = config.unknowns.names[field] if config.unknowns.mixed else bodies.u.name
    what = f"part {name} of the mixed space" if name.isdigit() else f"the {config.name} '{name}'"
    return FloatingBodyError(
        f"nothing holds {what} on the body with its middle at {described(sums[:-1] / sums[-1])}: it becomes {largest:.3g} there, and "
        f"{residual:.3g} of what drives it is left; give it a Dirichlet condition, or something that its value is to reach equilibrium with"
    )
