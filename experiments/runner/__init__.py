"""How a study is run: alone, in a sweep, on a cluster, tracked.

Each module imports those named before it: jobs, plan, compose, compared, tracking, cluster,
engine, job.
"""
