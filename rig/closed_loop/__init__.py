"""Model and observers in closed loop: its linear map, its poles, and what is observable."""
