"""What is measured, on disk, in tables and in documents, with the statistics behind it."""
