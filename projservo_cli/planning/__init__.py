"""Motion planning in joint space with a visible face: goal configurations, constraints, search, timing."""
