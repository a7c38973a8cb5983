"""Studies families, one room each: which tables, figures and claims an experiment yields.

Begin with a small one, `ranging.ranging`; `toolkit` has what several share.
"""
