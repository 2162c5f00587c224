"""What studies share: settings, building, records, the store."""
