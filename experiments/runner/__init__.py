"""How a study is run: alone, in a sweep, on a cluster, tracked.

Each room imports those named before it: jobs, planning, collecting, tracking, execution.
"""
