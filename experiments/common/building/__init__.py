"""From a configuration to what it describes: valve, mesh, closure, truth, data and filter."""
