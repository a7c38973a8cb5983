"""Motion and measurement models: written once, for simulators and estimators alike."""
