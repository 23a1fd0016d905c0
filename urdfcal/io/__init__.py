"""Read and write session folders, check their content, and record sessions in memory."""
