"""Models and methods: how a state moves and is measured, and how any such state is estimated."""
