"""Pages in the browser: grasps, the studio that makes them, and motions of an arm."""

from dro_grasp.extras import require_extra

require_extra("apps")
