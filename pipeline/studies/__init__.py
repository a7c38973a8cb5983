"""Studies, one room per family: which tables, figures and claims an experiment yields.

Begin with a small one, `ranging.ranging`; `toolkit` has what several share.
"""
