"""The filters, each a function of a model, a prior and an observation."""
