"""viewer."""

from doojax.optional import require

require("viser", "PIL", "imageio", "matplotlib")
