"""What readers of text files share: marks, blanks and ends of lines, words that are numbers, rows, names of columns."""
