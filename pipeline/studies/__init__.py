"""Studies, one package per family: which tables, figures and claims an experiment yields.

Begin with a small one, `ranging.ranging`; `toolkit` has what several share. Verdicts on claims come
from `pipeline.output.claims`.
"""
