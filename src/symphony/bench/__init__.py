"""The test bench for planners: suites of thresholds, what decides them, and what is written of them."""
