"""Types of the module `huddle`, installed as the stub package ``huddle-stubs``.

A single module cannot hold the marker ``py.typed`` (PEP 561).
"""

from daq.errors import HuddleError as HuddleError
from estimator.errors import EstimatorError as EstimatorError
from tui.notebook.archives import archive as archive
from tui.notebook.estimates import estimate as estimate
from tui.notebook.estimates import self_noise as self_noise
from tui.notebook.options import EstimateOptions as EstimateOptions
from tui.notebook.planning import RecordingPlan as RecordingPlan
from tui.notebook.planning import plan as plan
from tui.notebook.recording import RecordingFile as RecordingFile
from tui.notebook.recording import Waveforms as Waveforms
from tui.notebook.recording import open as open  # noqa: A004 - huddle.open
from tui.notebook.recording import read as read
from tui.notebook.result import Result as Result
from tui.notebook.simulation import Simulation as Simulation
from tui.notebook.simulation import simulate as simulate
from tui.notebook.verbs import calibrate as calibrate
from tui.notebook.verbs import export as export
from tui.notebook.verbs import load as load
from tui.notebook.verbs import noise_model as noise_model
from tui.notebook.verbs import report as report

__version__: str
