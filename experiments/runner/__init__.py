"""How a study is run: alone, in a sweep, on a cluster, tracked.

Each module imports only those named before it: jobs, plan, compose, metrics, tracking, cluster,
engine, job, sweep, plugins.
"""
