"""Cases, volumes and patients: what the studies that personalise a valve share."""
