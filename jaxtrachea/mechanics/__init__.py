"""Force law, ligament beam, rings and their equilibrium."""
