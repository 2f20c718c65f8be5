"""Each name and its home, read by type checkers and by lazy_loader."""

from .classifier import Classifier as Classifier
from .config import PaperConfig as PaperConfig
from .config import PaperOptions as PaperOptions
from .loop import PAPER_TOUCHES as PAPER_TOUCHES
from .loop import LoopResult as LoopResult
from .loop import beliefs as beliefs
from .loop import choose_hypothesis as choose_hypothesis
from .loop import nearest_distance as nearest_distance
from .loop import sample_hypothesis as sample_hypothesis
from .loop import site_informativeness as site_informativeness
from .loss import losses as losses
from .network import Prediction as Prediction
from .network import prepare_patch as prepare_patch
from .rules import BELIEF_RULES as BELIEF_RULES
from .rules import average as average
from .rules import distances as distances
from .rules import product as product
from .rules import votes as votes
