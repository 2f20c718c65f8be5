"""Each name and its home, read by type checkers and by lazy_loader."""

from .catalogue import HAND_TOOLS as HAND_TOOLS
from .catalogue import NAMES as NAMES
from .catalogue import PRIMITIVES as PRIMITIVES
from .catalogue import STAMPS as STAMPS
from .catalogue import make_object as make_object
from .catalogue import random_object as random_object
from .catalogue import surrogate_unknown as surrogate_unknown
from .mesh_cleaning import CleaningReport as CleaningReport
from .mesh_cleaning import clean_mesh as clean_mesh
from .mesh_files import load_mesh as load_mesh
from .mesh_files import load_object as load_object
from .mesh_files import read_mesh as read_mesh
from .poses import contact_pose as contact_pose
from .poses import point_on_ray as point_on_ray
from .solids import Mesh as Mesh
from .solids import Object as Object
from .solids import place_on_table as place_on_table
from .solids import transform_mesh as transform_mesh
