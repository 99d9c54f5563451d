"""Studies: designed experiments over configurations, their analysis, and a search for configurations that hold.

The libraries of the extra ``study`` (pyDOE3, SALib, statsmodels, scikit-learn, Optuna, filelock) are imported when they
are first used.
"""
