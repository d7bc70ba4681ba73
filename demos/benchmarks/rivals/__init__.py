"""Other methods of contact on the loop, surfaces and searches of the package: springs, multipliers, a barrier."""
