"""Hard cases: the product's functions at the ends of their ranges, held to closed forms and to float64."""
