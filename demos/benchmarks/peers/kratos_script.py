"""Solves the scene of ``by_kratos.py`` with Kratos in a process of its own: ``scene.npz answer.json``.

Runs in any Python that has Kratos' contact application and NumPy, and needs nothing else.
"""

import json
import sys
import time

import KratosMultiphysics as Kratos
import KratosMultiphysics.ContactStructuralMechanicsApplication as Contact
import KratosMultiphysics.LinearSolversApplication  # noqa: F401
import KratosMultiphysics.StructuralMechanicsApplication as Structural
import numpy as np
from KratosMultiphysics.StructuralMechanicsApplication.structural_mechanics_analysis import StructuralMechanicsAnalysis

Kratos.Logger.GetDefaultOutput().SetSeverity(Kratos.Logger.Severity.WARNING)
scene = np.load(sys.argv[1])
x, cells, supports = scene["x"], scene["cells"], json.loads(str(scene["supports"]))
rtol, linear_solver = float(scene["rtol"]), json.loads(str(scene["linear_solver"]))
SURFACES = ("contactor", "target")
MOST_ITERATIONS = 60


def prescribed(surface, component, value):
    """A prescribed component of displacement on a surface."""
    parameters = {
        "model_part_name": f"Structure.{surface}_{component}",
        "variable_name": "DISPLACEMENT",
        "interval": [0.0, "End"],
        "constrained": [i == component for i in range(3)],
        "value": [value if i == component else None for i in range(3)],
    }
    return {"python_module": "assign_vector_variable_process", "kratos_module": "KratosMultiphysics", "Parameters": parameters}


def settings():
    """Settings of one step."""
    solver = {
        "solver_type": "static",
        "model_part_name": "Structure",
        "domain_size": 3,
        "echo_level": 0,
        "analysis_type": "non_linear",
        "model_import_settings": {"input_type": "use_input_model_part"},
        "material_import_settings": {"materials_filename": ""},
        "time_stepping": {"time_step": 1.1},
        "clear_storage": True,
        "reform_dofs_at_each_step": True,
        "compute_reactions": True,
        "convergence_criterion": "contact_residual_criterion",
        "residual_relative_tolerance": rtol,
        "residual_absolute_tolerance": 0.0,
        "max_iteration": MOST_ITERATIONS,
        "linear_solver_settings": linear_solver,
        "contact_settings": {
            "mortar_type": "ALMContactFrictionless",
            "fancy_convergence_criterion": False,
            "inner_loop_iterations": MOST_ITERATIONS,
            "contact_residual_relative_tolerance": rtol,
            "contact_residual_absolute_tolerance": 0.0,
        },
    }
    contact = {
        "python_module": "alm_contact_process",
        "kratos_module": "KratosMultiphysics.ContactStructuralMechanicsApplication",
        "process_name": "ALMContactProcess",
        "Parameters": {
            "model_part_name": "Structure",
            "contact_model_part": {"0": ["contactor", "target"]},
            # Kratos' word for the contactor
            "assume_master_slave": {"0": ["contactor"]},
            "contact_type": "Frictionless",
        },
    }
    return {
        "problem_data": {"problem_name": "hertz", "parallel_type": "OpenMP", "start_time": 0.0, "end_time": 1.0, "echo_level": 0},
        "solver_settings": solver,
        "processes": {"supports": [prescribed(*support) for support in supports], "contact": [contact]},
    }


def fill(whole):
    """Nodes, cells and surfaces of both bodies."""
    material = whole.CreateNewProperties(1)
    material[Kratos.YOUNG_MODULUS], material[Kratos.POISSON_RATIO] = float(scene["E"]), float(scene["nu"])
    material[Kratos.DENSITY] = 1.0
    material[Kratos.CONSTITUTIVE_LAW] = Structural.LinearElastic3DLaw()
    for i, place in enumerate(x.tolist(), 1):
        whole.CreateNewNode(i, *place)
    for i, nodes in enumerate((cells + 1).tolist(), 1):
        whole.CreateNewElement("SmallDisplacementElement3D4N", i, nodes, material)
    count = 0
    for surface in SURFACES:
        part, facets = whole.CreateSubModelPart(surface), scene[f"facets_{surface}"] + 1
        part.AddNodes(np.unique(facets).tolist())
        for nodes in facets.tolist():
            count += 1
            part.CreateNewCondition("SurfaceCondition3D3N", count, nodes, material)
    for surface, component, _ in supports:
        part = whole.CreateSubModelPart(f"{surface}_{component}")
        part.AddNodes((scene[surface] + 1).tolist())


def solve():
    """Seconds, iterations, convergence, force and largest pressure."""
    model = Kratos.Model()
    whole = model.CreateModelPart("Structure")
    whole.SetBufferSize(2)
    whole.ProcessInfo[Kratos.DOMAIN_SIZE] = 3
    analysis = StructuralMechanicsAnalysis(model, Kratos.Parameters(json.dumps(settings())))
    fill(whole)
    start = time.process_time()
    analysis.Initialize()
    solver = analysis._GetSolver()
    analysis.time = solver.AdvanceInTime(analysis.time)
    analysis.InitializeSolutionStep()
    solver.Predict()
    converged = solver.SolveSolutionStep()
    analysis.FinalizeSolutionStep()
    seconds = time.process_time() - start
    P = sum(whole.Nodes[int(i)].GetSolutionStepValue(Kratos.REACTION)[2] for i in scene["block_bottom"] + 1)
    pressure = [node.GetValue(Contact.AUGMENTED_NORMAL_CONTACT_PRESSURE) for node in whole.GetSubModelPart("contactor").Nodes]
    iterations = whole.ProcessInfo[Kratos.NL_ITERATION_NUMBER]
    return seconds, iterations, converged, P, -min(pressure)


seconds = []
while not seconds or (len(seconds) <= int(scene["runs"]) and sum(seconds) < float(scene["enough"])):
    latest, iterations, converged, P, pressure = solve()
    seconds.append(latest)
answer = {"seconds": seconds, "iterations": int(iterations), "converged": bool(converged), "P": abs(P), "p_max": pressure}
with open(sys.argv[2], "w", encoding="utf-8") as out:
    json.dump(answer, out)
