"""Its place puts this folder on the import path: helpers here serve all tests."""
