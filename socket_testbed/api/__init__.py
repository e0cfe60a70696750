"""The public Python API: what the command line uses, for notebooks and scripts.

`import socket_testbed as st` provides the functions; heavy libraries are imported on first use.
Functions behave like their verbs: they report the same notes (as warnings) and write the same
files. Results saved by `save` or `draw` replace older ones; a trial, a report and a calibrated
cluster replace none unless asked.
Fits run linear algebra in a single thread, so that a trial gives the same model on every machine.

Functions that take a trial also accept its path. Errors are `TestbedError`s with one line, what is
wrong and how to fix it: a `ConfigurationError` for a wrong setting or file, a `TrialError` for a
trial that is unreadable or lacks the segment, an `IdentificationError` for samples that cannot be
fitted, a `CalibrationError`, `ScanError` or `RegistrationError` for data that cannot be calibrated,
tiled or registered. The examples run in a folder with two simulated trials.

Units, frames and signs, unless stated otherwise:

- Lengths are in m, forces in N, moments in N m, pressures in Pa, angles in rad, times in s since
  the first sample of the trial. A table states the unit of each column in its title, such as
  `pressure [kPa]`.
- {S} is the frame of the load cell. {L} is the frame of a tile: its origin is the tile's centre, z
  the inward normal of the surface, x the tangent towards the proximal end, y = z x x.
- Every force is that of the limb on the socket. A wrench is ordered [M; F]: three moments, then
  three forces. Pressure is positive in compression, where the force is along -z of {L}.
- Shapes name N samples, n tiles, c clusters, R regions; the first axis of an array is that of the
  samples. Channels are ordered as in `Samples.channels`: the wrench's six, then three per cluster.
- An interval is a 95 % interval. Missing and unknown values are NaN.
"""

# The only list of public names; `socket_testbed` re-exports it.
from socket_testbed.api.comparison import compare
from socket_testbed.api.cycles import cycles
from socket_testbed.api.design import calibrate, register, tile
from socket_testbed.api.export import export
from socket_testbed.api.imports import import_trial
from socket_testbed.api.models import evaluate, fit, predict, read_model
from socket_testbed.api.pages import view, write_comparison, write_report, write_survey
from socket_testbed.api.pressure import force_map, pressure
from socket_testbed.api.survey import survey
from socket_testbed.api.tradeoff import paper, pareto
from socket_testbed.api.trials import annotate, check_data, open_trial, simulate
from socket_testbed.api.validation import validate
from socket_testbed.errors import TestbedError
from socket_testbed.identification.contact import register_law
from socket_testbed.results.calibration import CalibratedCluster
from socket_testbed.results.comparison import Comparison
from socket_testbed.results.cycles import Cycles
from socket_testbed.results.models import Evaluation, TrialFit
from socket_testbed.results.pressure import TrialMap, TrialPressure
from socket_testbed.results.result import Result
from socket_testbed.results.survey import Survey
from socket_testbed.results.tradeoff import PaperTable, Tradeoff
from socket_testbed.results.validation import Validation
