"""Forces for a hand, at a rate of their own."""
