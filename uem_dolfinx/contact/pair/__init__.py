"""One contact of a problem as the solver sees it: its contactors, active set and forces."""
