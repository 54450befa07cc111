"""One trial: a question, a method, its time, its memory and its error."""
