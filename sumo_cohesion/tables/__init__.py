"""What runs leave behind: tables, their columns, metrics and statistics; nothing else."""
