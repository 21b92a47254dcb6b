"""Reports: one HTML page for one run, or for several side by side, which needs no network.

A page is drawn from run directories alone. Its charts are those of Plotly (MIT licence), whose program it carries.
"""

from pirl_rl.reports.page import write_report

__all__ = ["write_report"]
