"""The public Python API: what the command line uses, for notebooks and scripts.

`import socket_testbed as st` provides the functions; heavy libraries are imported on first use.
Functions behave like their verbs: they report the same notes (as warnings) and write the same
files, but replace older ones.
Fits run linear algebra in a single thread, so that a trial gives the same model on every machine.

Functions that take a trial also accept its path. Lengths are in metres, forces in newtons, times
in seconds. Errors are `TestbedError`s with one line, what is wrong and how to fix it: a
`ConfigurationError` for a wrong setting or file, a `TrialError` for a trial that is unreadable or
lacks the segment, an `IdentificationError` for samples that cannot be fitted, a
`CalibrationError`, `ScanError` or `RegistrationError` for data that cannot be calibrated, tiled
or registered. The examples run in a folder with two simulated trials.
"""

# The only list of public names; `socket_testbed` re-exports it.
from socket_testbed.api.comparison import Comparison as Comparison
from socket_testbed.api.comparison import compare as compare
from socket_testbed.api.cycles import Cycles as Cycles
from socket_testbed.api.cycles import cycles as cycles
from socket_testbed.api.design import CalibratedCluster as CalibratedCluster
from socket_testbed.api.design import calibrate as calibrate
from socket_testbed.api.design import register as register
from socket_testbed.api.design import tile as tile
from socket_testbed.api.export import export as export
from socket_testbed.api.models import Evaluation as Evaluation
from socket_testbed.api.models import TrialFit as TrialFit
from socket_testbed.api.models import evaluate as evaluate
from socket_testbed.api.models import fit as fit
from socket_testbed.api.models import predict as predict
from socket_testbed.api.models import read_model as read_model
from socket_testbed.api.pages import view as view
from socket_testbed.api.pages import write_comparison as write_comparison
from socket_testbed.api.pages import write_report as write_report
from socket_testbed.api.pressure import TrialMap as TrialMap
from socket_testbed.api.pressure import TrialPressure as TrialPressure
from socket_testbed.api.pressure import force_map as force_map
from socket_testbed.api.pressure import pressure as pressure
from socket_testbed.api.result import Result as Result
from socket_testbed.api.tradeoff import PaperTable as PaperTable
from socket_testbed.api.tradeoff import Tradeoff as Tradeoff
from socket_testbed.api.tradeoff import paper as paper
from socket_testbed.api.tradeoff import pareto as pareto
from socket_testbed.api.trials import annotate as annotate
from socket_testbed.api.trials import check_data as check_data
from socket_testbed.api.trials import open_trial as open_trial
from socket_testbed.api.trials import select_segment as select_segment
from socket_testbed.api.trials import simulate as simulate
from socket_testbed.api.validation import Validation as Validation
from socket_testbed.api.validation import validate as validate
from socket_testbed.errors import TestbedError as TestbedError
