"""What the physics is: laws, elements, loads, contact, time integration, sensitivities."""
