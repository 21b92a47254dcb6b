"""Reports: one HTML page for one run, or for several side by side, which needs no network.

A page is drawn from run directories alone. Its charts are those of Plotly (MIT licence), whose program it carries.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pirl_rl.reports.page import write_report

__all__ = ["write_report"]


def __getattr__(name: str) -> Any:
    """Import the pages when they are first asked for: they need matplotlib, which takes a second to load."""
    if name != "write_report":
        raise AttributeError(f"module {__name__} has no attribute {name!r}")
    from pirl_rl.reports.page import write_report

    return write_report
