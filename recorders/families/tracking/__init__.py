"""Records many targets: crossing ways, reports of vessels, ferries; begin with `crossing`."""
