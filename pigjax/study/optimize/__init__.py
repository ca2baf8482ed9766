"""Sweeps over parameters, and the search for the best: of any pure function."""

from pigjax.study.optimize.bounds import Bounds
from pigjax.study.optimize.fit import History, fit
from pigjax.study.optimize.search import search
from pigjax.study.optimize.sweep import sweep
from pigjax.study.optimize.table import Table, load_table

__all__ = ["Bounds", "History", "Table", "fit", "load_table", "search", "sweep"]
