"""Studies families, one package each: which tables, figures and claims an experiment yields.

Begin with a small one, `ranging.ranging`; `toolkit` has what several share. Verdicts on claims come
from `fuselog.pipeline.output.claims`.
"""
