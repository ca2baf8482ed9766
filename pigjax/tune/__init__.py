"""Sweeps over parameters, and the search for the best: of any pure function."""

from pigjax.tune.bounds import Bounds
from pigjax.tune.fit import History, fit
from pigjax.tune.search import search
from pigjax.tune.sweep import sweep
from pigjax.tune.table import Table, load_table

__all__ = ["Bounds", "History", "Table", "fit", "load_table", "search", "sweep"]
