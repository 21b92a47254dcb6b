"""Configuration of the documentation site, which `make docs` builds with Sphinx."""

from __future__ import annotations

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS / "_extensions"), str(DOCS.parent)]

project = "pirl_rl"
author = "The pirl_rl developers"
project_copyright = "the pirl_rl developers, MIT licence"
version = release = installed_version("pirl_rl")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "mathml",
    "pages",
    "plain_docstrings",
]
exclude_patterns = ["_build"]

# Pages are Markdown; notebooks show the outputs that they are stored with.
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_render_markdown_format = "myst"

# A literal block is an equation or a layout unless it names its language.
highlight_language = "none"
math_eqref_format = "Eq. ({number})"

# Docstrings are plain text in Google's style; see _extensions/plain_docstrings.py.
autodoc_preserve_defaults = True
autodoc_default_options = {"member-order": "bysource", "special-members": "__call__"}
napoleon_numpy_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "pirl_rl"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_show_sphinx = False

reference_rooms = {
    "api": ("From Python", ["pirl_rl.api"]),
    "problems": (
        "Problems, sets and payoffs",
        [
            "pirl_rl.problem",
            "pirl_rl.structure",
            "pirl_rl.sets",
            "pirl_rl.payoffs",
            "pirl_rl.constants",
            "pirl_rl.problems.cartpole",
            "pirl_rl.problems.double_integrator",
            "pirl_rl.problems.dubins",
            "pirl_rl.problems.exit1d",
            "pirl_rl.problems.halfspace",
            "pirl_rl.problems.pendulum",
            "pirl_rl.problems.quadrotor",
            "pirl_rl.problems.radial_exit",
            "pirl_rl.problems.reach1d",
            "pirl_rl.problems.safety1d",
            "pirl_rl.problems.zermelo",
        ],
    ),
    "drift": (
        "The drifting vehicle",
        [
            "pirl_rl.problems.drift.problem",
            "pirl_rl.problems.drift.three_state",
            "pirl_rl.problems.drift.vehicle",
            "pirl_rl.problems.drift.equilibria",
            "pirl_rl.problems.drift.starts",
            "pirl_rl.problems.drift.env",
            "pirl_rl.problems.drift.reference_states",
        ],
    ),
    "numerics": (
        "Simulator, time steps and operators",
        [
            "pirl_rl.simulator",
            "pirl_rl.clock",
            "pirl_rl.time_steps",
            "pirl_rl.rates",
            "pirl_rl.operators",
            "pirl_rl.internals",
        ],
    ),
    "grid": (
        "The grid solver",
        [
            "pirl_rl.grid",
            "pirl_rl.grid.solver",
            "pirl_rl.grid.solution",
            "pirl_rl.grid.mesh",
            "pirl_rl.grid.chain",
            "pirl_rl.grid.candidates",
            "pirl_rl.grid.stencil",
        ],
    ),
    "networks": ("Networks and schedules", ["pirl_rl.networks", "pirl_rl.layers", "pirl_rl.schedules"]),
    "sampling": (
        "States and points",
        ["pirl_rl.sampling.initial_states", "pirl_rl.sampling.collocation", "pirl_rl.sampling.boundary"],
    ),
    "actor_rules": (
        "Actor rules",
        [
            "pirl_rl.actor_rules.base",
            "pirl_rl.actor_rules.q",
            "pirl_rl.actor_rules.hamiltonian",
            "pirl_rl.actor_rules.look_ahead",
            "pirl_rl.actor_rules.best_control",
            "pirl_rl.ascent",
            "pirl_rl.action_values",
            "pirl_rl.cubature",
            "pirl_rl.actor_rules.clipped_surrogate",
            "pirl_rl.actor_rules.sum",
        ],
    ),
    "training": (
        "Environment, loss and training",
        [
            "pirl_rl.envs",
            "pirl_rl.losses",
            "pirl_rl.learner",
            "pirl_rl.recording",
            "pirl_rl.curriculum",
            "pirl_rl.trainer",
            "pirl_rl.guard",
            "pirl_rl.checkpoint",
            "pirl_rl.loggers",
            "pirl_rl.progress",
        ],
    ),
    "collectors": (
        "Collectors",
        [
            "pirl_rl.collectors",
            "pirl_rl.collectors.sync",
            "pirl_rl.collectors.multi_async",
            "pirl_rl.collectors.ray",
            "pirl_rl.collectors.player",
            "pirl_rl.collectors.joint",
            "pirl_rl.collectors.transitions",
            "pirl_rl.collectors.buffers",
        ],
    ),
    "evaluation": (
        "Solutions and evaluation",
        [
            "pirl_rl.solution",
            "pirl_rl.evaluation.evaluator",
            "pirl_rl.evaluation.inputs",
            "pirl_rl.evaluation.exact_error",
            "pirl_rl.evaluation.residuals",
            "pirl_rl.evaluation.largest_residual",
            "pirl_rl.evaluation.success",
            "pirl_rl.evaluation.calibration",
            "pirl_rl.evaluation.accuracy",
            "pirl_rl.evaluation.reference_states",
            "pirl_rl.evaluation.slices",
            "pirl_rl.evaluation.rollouts",
            "pirl_rl.evaluation.rollout_comparison",
            "pirl_rl.evaluation.trajectories",
            "pirl_rl.evaluation.monte_carlo",
        ],
    ),
    "certificates": (
        "Certificates",
        [
            "pirl_rl.certificates.certificate",
            "pirl_rl.certificates.claim",
            "pirl_rl.certificates.deployed",
            "pirl_rl.certificates.success",
            "pirl_rl.certificates.threshold",
            "pirl_rl.certificates.band",
            "pirl_rl.certificates.states",
            "pirl_rl.certificates.bounds",
            "pirl_rl.certificates.sequence",
        ],
    ),
    "proofs": (
        "Proofs",
        [
            "pirl_rl.proofs.proof",
            "pirl_rl.proofs.prover",
            "pirl_rl.proofs.conditions",
            "pirl_rl.proofs.search",
            "pirl_rl.proofs.fit",
            "pirl_rl.proofs.subsolution",
            "pirl_rl.proofs.points",
            "pirl_rl.proofs.faces",
            "pirl_rl.proofs.mesh",
            "pirl_rl.proofs.spline",
            "pirl_rl.proofs.polynomials",
            "pirl_rl.proofs.boxes",
            "pirl_rl.proofs.affine",
            "pirl_rl.proofs.functions",
            "pirl_rl.proofs.structure",
        ],
    ),
    "deployment": (
        "Models for other programs",
        [
            "pirl_rl.deployment",
            "pirl_rl.deployment.program",
            "pirl_rl.deployment.graph",
            "pirl_rl.deployment.model",
            "pirl_rl.deployment.description",
        ],
    ),
    "filters": (
        "Filters and Gymnasium",
        [
            "pirl_rl.filters.filter",
            "pirl_rl.filters.least_restrictive",
            "pirl_rl.filters.submartingale",
            "pirl_rl.filters.smallest_change",
            "pirl_rl.filters.step_ahead",
            "pirl_rl.gymnasium",
            "pirl_rl.gymnasium.environments",
            "pirl_rl.gymnasium.registration",
            "pirl_rl.gymnasium.filtered",
        ],
    ),
    "figures": (
        "Figures",
        [
            "pirl_rl.figures.evidence",
            "pirl_rl.figures.run",
            "pirl_rl.figures.training",
            "pirl_rl.figures.one_dimensional",
            "pirl_rl.figures.accuracy",
            "pirl_rl.figures.slices",
            "pirl_rl.figures.rollouts",
            "pirl_rl.figures.comparison",
            "pirl_rl.figures.sweep",
            "pirl_rl.figures.tree",
            "pirl_rl.figures.files",
        ],
    ),
    "runs": (
        "Runs and configuration",
        [
            "pirl_rl.runs.run",
            "pirl_rl.runs.load",
            "pirl_rl.runs.compare",
            "pirl_rl.runs.sweeps",
            "pirl_rl.run_directory",
            "pirl_rl.machine",
            "pirl_rl.renames",
            "pirl_rl.configuration",
            "pirl_rl.building",
            "pirl_rl.assembly",
            "pirl_rl.automatic",
            "pirl_rl.continuation",
            "pirl_rl.errors",
        ],
    ),
    "reports": (
        "Reports",
        [
            "pirl_rl.reports",
            "pirl_rl.reports.page",
            "pirl_rl.reports.contents",
            "pirl_rl.reports.statement",
            "pirl_rl.reports.equations",
            "pirl_rl.reports.names",
            "pirl_rl.reports.outlines",
            "pirl_rl.reports.maps",
            "pirl_rl.reports.line",
            "pirl_rl.reports.paths",
            "pirl_rl.reports.curves",
            "pirl_rl.reports.meanings",
            "pirl_rl.reports.packing",
        ],
    ),
    "commands": (
        "Commands",
        [
            "pirl_rl.commands.composition",
            "pirl_rl.commands.methods",
            "pirl_rl.commands.settings",
            "pirl_rl.commands.console",
            "pirl_rl.commands.train",
            "pirl_rl.commands.evaluate",
            "pirl_rl.commands.certify",
            "pirl_rl.commands.export",
            "pirl_rl.commands.report",
            "pirl_rl.commands.tune",
            "pirl_rl.commands.catalogue",
        ],
    ),
    "outer_loop": (
        "The outer loop",
        [
            "pirl_rl.outer_loop.advisors",
            "pirl_rl.outer_loop.advisors.greedy",
            "pirl_rl.outer_loop.advisors.optuna",
            "pirl_rl.outer_loop.advisors.command",
            "pirl_rl.outer_loop.advisors.openai",
            "pirl_rl.outer_loop.advisors.file",
            "pirl_rl.outer_loop.plan",
            "pirl_rl.outer_loop.history",
            "pirl_rl.outer_loop.parsing",
            "pirl_rl.outer_loop.prompt",
            "pirl_rl.outer_loop.loop",
            "pirl_rl.outer_loop.record",
            "pirl_rl.outer_loop.report",
        ],
    ),
}
"""Pages of the API reference: the name of each page, its title and the modules on it."""
