"""How a study is run: alone, in a sweep, on a cluster, tracked."""
