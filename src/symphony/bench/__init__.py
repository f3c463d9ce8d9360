"""The test bench for planners: suites of thresholds, their verdicts, and the pages and files that tell them."""
