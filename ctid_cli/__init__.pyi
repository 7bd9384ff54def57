# The public names of ctid, by topic. Everything else is internal and may change without notice.

# ruff: noqa: I001  the topics are the order

__version__: str

# Records and the signals that excite and disturb them
from .signals.held import HeldSignal as HeldSignal
from .signals.record import Loop as Loop, Record as Record
from .signals.measurement import read_record as read_record
from .signals.frequency_data import FrequencyData as FrequencyData, read_frequency_data as read_frequency_data
from .signals.excitation import Gaussian as Gaussian, Prbs as Prbs, Step as Step
from .signals.multisine import Multisine as Multisine
from .signals.sampling import RegularSampling as RegularSampling, UniformIntervals as UniformIntervals
from .signals.noise import ArmaNoise as ArmaNoise, WhiteNoise as WhiteNoise

# Models
from .models.transfer_function import TransferFunction as TransferFunction
from .models.additive import AdditiveModel as AdditiveModel, Submodel as Submodel, Term as Term
from .models.controller import ContinuousController as ContinuousController
from .models.controller import DiscreteController as DiscreteController

# Exact simulation
from .filtering.simulate import simulate as simulate
from .filtering.simulate import simulate_additive as simulate_additive
from .filtering.loop import simulate_loop as simulate_loop

# Estimators of systems: options with ``fit(record, start)``
from .estimation.common import Start as Start
from .estimators.svf import Svf as Svf
from .estimators.rivc import Rivc as Rivc
from .estimators.srivc import Srivc as Srivc
from .estimators.td_srivc import TdSrivc as TdSrivc
from .estimators.useful_redundancy import UsefulRedundancy as UsefulRedundancy
from .estimators.delay_profile import DelayProfile as DelayProfile, InputModel as InputModel
from .estimators.additive_output_error import AdditiveOutputError as AdditiveOutputError
from .estimators.additive_srivc import AdditiveSrivc as AdditiveSrivc
from .estimators.loop_output_error import LoopOutputError as LoopOutputError
from .estimators.measured_submodels import MeasuredSubmodels as MeasuredSubmodels
from .estimators.frequency_domain import FrequencyDomain as FrequencyDomain, FrequencyDomainSum as FrequencyDomainSum
from .estimation.common import Bound as Bound, Fixed as Fixed
from .estimators.identification import Identification as Identification
from .identification.choice import Choice as Choice, Given as Given
from .identification.choose import choose as choose
from .identification.criterion import Candidate as Candidate
from .identification.identify import identify as identify
from .identification.identify_response import identify_frequency_response as identify_frequency_response

# Results
from .inference.fit import Fit as Fit, Status as Status
from .inference.fitted_model import FittedModel as FittedModel
from .inference.model_responses import FrequencyBand as FrequencyBand, PoleBand as PoleBand
from .inference.model_responses import ResponseBand as ResponseBand
from .estimators.additive_srivc import AdditiveFit as AdditiveFit
from .estimators.measured_fit import MeasuredFit as MeasuredFit, MultiInputFit as MultiInputFit
from .estimators.loop_output_error import LoopFit as LoopFit
from .estimators.measured_submodels import SubmodelsFit as SubmodelsFit
from .estimators.frequency_domain import FrequencyDomainFit as FrequencyDomainFit
from .estimators.frequency_domain import FrequencyDomainSumFit as FrequencyDomainSumFit
from .estimators.useful_redundancy import RedundantFit as RedundantFit
from .inference.criteria import fit_percent as fit_percent
from .inference.frequency_response import FrequencyResponse as FrequencyResponse
from .inference.frequency_response import estimate_frequency_response as estimate_frequency_response
from .inference.bounds import cramer_rao_bound as cramer_rao_bound

# Fits as files
from .estimators.model_comparison import ModelOnRecord as ModelOnRecord, compare as compare
from .storage.fit_file import load_fit as load_fit
from .reporting.fit_result import save_fit as save_fit

# Custom components: the classes that they derive from
from .signals.excitation import Excitation as Excitation
from .signals.sampling import Sampling as Sampling
from .simulation.components import Estimator as Estimator, Measure as Measure, Noise as Noise, System as System

# Experiments: what ctid run, table and export do
from .reporting.experiment import ExperimentResults as ExperimentResults
from .reporting.experiment import read_results as read_results, run_experiment as run_experiment
from .running.plan import simulate_dataset as simulate_dataset

# Useful redundancy for a cost of one's own
from .filtering.lowpass import Lowpass as Lowpass
from .filtering.filter_set import FilterSet as FilterSet, check_filters as check_filters
from .estimation.redundancy import RedundantMinimum as RedundantMinimum, minimise_redundantly as minimise_redundantly

# Frequencies of signals
from .frequency.flags import Flag as Flag
from .frequency.base import FrequencyEstimator as FrequencyEstimator, FrequencyTrack as FrequencyTrack
from .frequency.drem import DremGradient as DremGradient, DremFiniteTime as DremFiniteTime, DremWindow as DremWindow
from .frequency.restarting_least_squares import RestartingLeastSquares as RestartingLeastSquares

# Tones of recorded signals
from .tones.track import MissingLine as MissingLine, Track as Track, track as track

# Errors
from .errors import CtidError as CtidError, DataError as DataError, SpecError as SpecError
