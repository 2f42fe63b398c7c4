"""The site of the documentation: sphinx-build -W docs site"""

import os
import sys
from importlib.metadata import version as installed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))
# Cells call the command warpcloth of this environment, also if it is not activated.
os.environ["TQDM_DISABLE"] = "1"  # no progress bars in the output of cells
# A command that fails ends the build, as an exception does.
os.environ["PYTHONSTARTUP"] = str(Path(__file__).parent / "_ext" / "cells.py")
os.environ["PATH"] = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))

project, author, copyright = "warpcloth", "the authors of warpcloth", "the authors of warpcloth, Apache-2.0"
release = version = installed("warpcloth")
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
    "records",
]
exclude_patterns = ["_ext"]

# Pages. Headings have the anchors that file hosts give them, so that links between pages hold in the checkout too.
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
# Cells run when the site is built, in a folder of their own; an error ends the build.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_execution_timeout = 300
nb_merge_streams = True
smartquotes = False  # they turn the two hyphens of an option into a dash

# The site fetches nothing: MathJax 3.2.2, Apache-2.0, from the package mathjax of npm, lies in _static.
html_theme = "furo"
html_title = "warpcloth"
html_static_path = ["_static"]
html_css_files = ["site.css"]
mathjax_path = "mathjax/tex-svg.js"
mathjax3_config = {"options": {"enableMenu": False}}  # its entries for accessibility would fetch code
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True

# The reference.
autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]
