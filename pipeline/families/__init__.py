"""Studies of single families, one package each: the tables, figures and claims of an experiment.

Nothing outside imports these packages: they register themselves. Begin with a small one,
`ranging.study`. `fuselog.pipeline.studies.toolkit` has the parts that several studies use. Verdicts on
claims come from `fuselog.pipeline.output.claims`.
"""
