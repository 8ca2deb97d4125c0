"""Mutations of the host's estimators; see scripts/mutations."""

QUICK = ["map watch: a contradiction by the sum of sigmas"]

# name, source, text, its replacement
MUTATIONS = [
    ("map watch: a contradiction by the sum of sigmas", "host/filter/map_watch.cpp", "model::square(kSigmas) * (variance_m2", "kSigmas * (variance_m2"),
]
