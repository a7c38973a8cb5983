"""Studies families, one package each: which tables, figures and claims an experiment yields.

Nothing outside imports them: they register. Begin with a small one, `ranging.study`;
`fuselog.pipeline.studies.toolkit` has what several share. Verdicts on claims come from
`fuselog.pipeline.output.claims`.
"""
