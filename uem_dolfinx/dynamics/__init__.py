"""Mass, inertia and time integration."""
