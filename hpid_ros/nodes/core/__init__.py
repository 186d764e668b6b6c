"""What every node needs: executor, supervisor, services, parameters, status."""
