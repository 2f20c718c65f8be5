"""Each name and its home, read by type checkers and by lazy_loader."""

from .fit import fit_predictor as fit_predictor
from .methods import METHODS as METHODS
from .methods import Method as Method
from .methods import TrainingTouches as TrainingTouches
from .methods import find_method as find_method
from .methods import find_methods as find_methods
from .metrics import PredictorScore as PredictorScore
from .metrics import Score as Score
from .metrics import score as score
from .networks import OnPressure as OnPressure
from .networks import PaperDepth as PaperDepth
from .networks import PaperDepthForce as PaperDepthForce
from .networks import PaperMask as PaperMask
from .networks import PaperMaskForce as PaperMaskForce
from .predictor import Predictor as Predictor
from .predictor import load_predictor as load_predictor
from .splitting import choose_split as choose_split
from .touch_model import Reading as Reading
from .touch_model import TouchBatch as TouchBatch
from .touch_model import TouchModel as TouchModel
