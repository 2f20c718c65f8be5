"""The public face: each name and its home, and the packages of the second tier.

Type checkers read it, and lazy_loader when the package is imported.
"""

from . import hardware as hardware
from . import paper as paper
from . import prediction as prediction
from . import recognition as recognition
from . import simulation as simulation
from . import skin_models as skin_models
from . import viz as viz
from .contact.press import PressLimits as PressLimits
from .dataset.sets import Dataset as Dataset
from .dataset.splits import Split as Split
from .dataset.store import load_dataset as load_dataset
from .dataset.store import save_dataset as save_dataset
from .depth.camera import Camera as Camera
from .depth.patches import SurfaceTracing as SurfaceTracing
from .depth.patches import patch_from_depth as patch_from_depth
from .depth.pixel_pose import PlaneFit as PlaneFit
from .depth.pixel_pose import pose_at_pixel as pose_at_pixel
from .errors import DataError as DataError
from .errors import DeviceError as DeviceError
from .errors import I2TError as I2TError
from .objects.catalogue import make_object as make_object
from .objects.mesh_files import load_mesh as load_mesh
from .objects.poses import contact_pose as contact_pose
from .objects.solids import Mesh as Mesh
from .paper.config import PaperOptions as PaperOptions
from .prediction.fit import fit_predictor as fit_predictor
from .prediction.methods import Method as Method
from .prediction.metrics import PredictorScore as PredictorScore
from .prediction.predictor import Predictor as Predictor
from .prediction.predictor import Reading as Reading
from .prediction.predictor import load_predictor as load_predictor
from .prediction.touch_model import TouchModel as TouchModel
from .recognition.paper_rules import PaperEpisodes as PaperEpisodes
from .recognition.paper_rules import run_paper_loop as run_paper_loop
from .recognition.recognizer import ObjectRecognizer as ObjectRecognizer
from .recognition.recognizer import RecognizerConfig as RecognizerConfig
from .recognition.site_pool import SitePool as SitePool
from .recognition.site_pool import prepare_surfaces as prepare_surfaces
from .registration.depth import DepthRegistrationConfig as DepthRegistrationConfig
from .registration.depth import register_by_depth as register_by_depth
from .registration.estimate import PoseEstimate as PoseEstimate
from .registration.session import SessionEstimate as SessionEstimate
from .registration.session import SessionRegistrationConfig as SessionRegistrationConfig
from .registration.session import register_session as register_session
from .registration.touch import TouchRegistrationConfig as TouchRegistrationConfig
from .registration.touch import register_by_touch as register_by_touch
from .rendering.render import prepare_surface as prepare_surface
from .rendering.render import render_patch as render_patch
from .runtime.compile_cache import use_compile_cache as use_compile_cache
from .simulation.site_limits import SiteLimits as SiteLimits
from .simulation.sites import sample_touch_sites as sample_touch_sites
from .simulation.touches import SimulationErrors as SimulationErrors
from .simulation.touches import simulate_touches as simulate_touches
from .skin.boards import anyskin_board as anyskin_board
from .skin.boards import reskin_board as reskin_board
from .skin.elasticity import Grid as Grid
from .skin.faults import Faults as Faults
from .skin.files import load_pad as load_pad
from .skin.files import save_pad as save_pad
from .skin.noise import Noise as Noise
from .skin.pad import Press as Press
from .skin.pad import nominal_pad as nominal_pad
from .skin.pad import press as press
from .skin.pad import sample_pad as sample_pad
from .skin_models.calibration import Calibration as Calibration
from .skin_models.calibration import calibrate as calibrate
from .skin_models.calibration import load_calibration as load_calibration
from .skin_models.pad_model import PadModel as PadModel
from .skin_models.pad_model import load_pad_model as load_pad_model
from .skin_models.tip_gp.structured import StructuredGPHyperparameters as StructuredGPHyperparameters
from .training import TrainConfig as TrainConfig
from .types import Board as Board
from .types import Pad as Pad
from .types import Patch as Patch
from .types import ReturnCode as ReturnCode
from .types import Surface as Surface
from .types import Touches as Touches
from .types import Truth as Truth

__all__: list[str]
__version__: str
