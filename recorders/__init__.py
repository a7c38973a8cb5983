"""The log contract, the sensor and motion models, the simulators and the importers of real data."""
