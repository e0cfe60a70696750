"""The public Python API: what the command line uses, for notebooks and scripts.

`import socket_testbed as st` gives the functions; the first use of one imports its libraries. A
function works under the same conditions as its verb: it reports the same notes (here as warnings),
computes in one thread of linear algebra, so that the same trial gives the same numbers on every
machine, and writes the same files.

Lengths are in metres, forces in newtons, times in seconds. An error is a `TestbedError` whose one
line says what is wrong and how to fix it. The examples run in a folder with two simulated trials.
"""

from socket_testbed.api.compare import compare, write_comparison
from socket_testbed.api.comparison import Comparison
from socket_testbed.api.cycles import Cycles, cycles
from socket_testbed.api.design import CalibratedCluster, calibrate, register, tile
from socket_testbed.api.maps import TrialMap, force_map
from socket_testbed.api.models import (
    Evaluation,
    Tradeoff,
    TrialFit,
    check_thetas,
    evaluate,
    export,
    fit,
    pareto,
    predict,
    read_model,
    write_report,
)
from socket_testbed.api.paper import PaperTable, paper
from socket_testbed.api.pressure import TrialPressure, pressure
from socket_testbed.api.result import Result
from socket_testbed.api.trials import annotate, open_trial, select_segment, simulate
from socket_testbed.api.validation import Validation, validate
from socket_testbed.api.view import TrialPage, require_viewer, view
from socket_testbed.errors import TestbedError

__all__ = [
    "CalibratedCluster",
    "Comparison",
    "Cycles",
    "Evaluation",
    "PaperTable",
    "Result",
    "TestbedError",
    "Tradeoff",
    "TrialFit",
    "TrialMap",
    "TrialPage",
    "TrialPressure",
    "Validation",
    "annotate",
    "calibrate",
    "check_thetas",
    "compare",
    "cycles",
    "evaluate",
    "export",
    "fit",
    "force_map",
    "open_trial",
    "paper",
    "pareto",
    "predict",
    "pressure",
    "read_model",
    "register",
    "require_viewer",
    "select_segment",
    "simulate",
    "tile",
    "validate",
    "view",
    "write_comparison",
    "write_report",
]
