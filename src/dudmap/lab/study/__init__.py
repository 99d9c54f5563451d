"""Studies: designed experiments over configurations, their analysis, and a search for configurations that hold.

The libraries of the extra ``study`` (pyDOE3, statsmodels, Optuna) are imported when they are first used.
"""
