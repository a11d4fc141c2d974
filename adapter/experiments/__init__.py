"""The paper's experiments (section IV) on data that is handed in: learn, compare, show."""
