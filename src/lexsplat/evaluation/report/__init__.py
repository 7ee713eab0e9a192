"""Results of an evaluation as an HTML page and as tables for the terminal, CSV and LaTeX."""

from lexsplat.evaluation.report.comparison import MeasuredMethod, write_comparison
from lexsplat.evaluation.report.gallery import Gallery
from lexsplat.evaluation.report.page import write_report
from lexsplat.evaluation.report.tables import format_rows, format_table, table_rows, write_rows

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
