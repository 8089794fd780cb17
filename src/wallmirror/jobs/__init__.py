"""What each command does, as a public function; the command line is a thin skin over these."""
