"""The evaluation as a page to look at, as tables for the terminal, CSV and LaTeX."""

from lexsplat.report.gallery import Gallery
from lexsplat.report.page import write_report
from lexsplat.report.side_by_side import MeasuredMethod, write_comparison
from lexsplat.report.tables import format_rows, format_table, table_rows, write_rows

__all__ = [
    "Gallery",
    "MeasuredMethod",
    "format_rows",
    "format_table",
    "table_rows",
    "write_comparison",
    "write_report",
    "write_rows",
]
