"""The report of a run: one HTML page that needs nothing but itself.

>>> from adapter.report import render, write_report
"""

from adapter.report.page import render, write_report

__all__ = ["render", "write_report"]
