"""The mortar discretisation: weighted gaps of dual shape functions over segments."""
