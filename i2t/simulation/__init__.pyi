"""Each name and its home, read by type checkers and by lazy_loader."""

from .depth_camera import DepthErrors as DepthErrors
from .depth_camera import add_depth_noise as add_depth_noise
from .depth_camera import render_view as render_view
from .depth_camera import shade_view as shade_view
from .depth_camera import table_triangles as table_triangles
from .press_curves import PressCurve as PressCurve
from .press_curves import simulate_press_curve as simulate_press_curve
from .site_limits import SiteLimits as SiteLimits
from .sites import COLLECTION_LIMITS as COLLECTION_LIMITS
from .sites import RECOGNITION_LIMITS as RECOGNITION_LIMITS
from .sites import TouchSites as TouchSites
from .sites import explain_unsafe as explain_unsafe
from .sites import sample_points as sample_points
from .sites import sample_touch_sites as sample_touch_sites
from .touches import SessionErrors as SessionErrors
from .touches import SimulationErrors as SimulationErrors
from .touches import sample_session_errors as sample_session_errors
from .touches import simulate_touch as simulate_touch
from .touches import simulate_touches as simulate_touches
from .touches import touch_simulator as touch_simulator
