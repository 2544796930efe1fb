"""The fast scheme: chunks of substeps captured as graphs, on sorted particles."""
