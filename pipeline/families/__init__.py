"""Studies by family of scenarios, with the tables, figures and claims of their experiments.

The packages register themselves, and nothing outside imports them. Begin with a small study,
`ranging.study`. `fuselog.pipeline.studies.toolkit` contains the parts that several studies use. Verdicts
on claims come from `fuselog.pipeline.output.claims`.
"""
